"""Inverse kinematics for the grasp point."""
