"""Trained policies: their network, and the folder in which one is kept."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.policy.checkpoint import Policy, load_policy, save_policy
from mjstack.policy.network import PolicyNetwork, Vision

__all__ = ["Policy", "PolicyNetwork", "Vision", "load_policy", "save_policy"]
