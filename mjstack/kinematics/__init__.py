"""Inverse kinematics for the aperture centre."""
