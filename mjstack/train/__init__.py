"""Trainers: how policies come about."""
