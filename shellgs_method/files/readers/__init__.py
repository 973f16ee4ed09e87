"""Readers of shell files, one module for each family of formats; each counts what it leaves out."""
