"""Trained policies: their network, and the folder in which one is kept."""

from mjstack.policy.checkpoint import Policy, load_policy, save_policy
from mjstack.policy.network import PolicyNetwork, Vision

__all__ = ["Policy", "PolicyNetwork", "Vision", "load_policy", "save_policy"]
