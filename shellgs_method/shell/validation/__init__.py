"""Validate an alignment and report the verdict."""
