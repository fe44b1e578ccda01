"""Drivers: they give the joint targets of every step."""
