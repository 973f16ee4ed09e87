"""One large scene in blocks: trained from a coarse run of all of it, merged, and measured along the seams."""

WEAK = 8
"""Photographs below which a block is joined with a neighbour."""
