"""Trained policies: their network, and the folder in which one is kept."""

from mjstack.policy.checkpoint import Policy, load_policy, save_policy
from mjstack.policy.network import PolicyNetwork

__all__ = ["Policy", "PolicyNetwork", "load_policy", "save_policy"]
