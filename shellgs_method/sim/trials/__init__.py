"""Trials of a world in MuJoCo."""
