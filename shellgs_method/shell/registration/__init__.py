"""Align the shell to the scene."""
