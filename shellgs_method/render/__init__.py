"""Gaussians to maps."""
