"""Runs as folders: config.yml and checkpoints as data, limits of settings, guards."""
