"""Collision geometry."""
