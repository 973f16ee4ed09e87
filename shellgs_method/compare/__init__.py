"""Compare methods, seeds and scenes: a grid of runs, launched, measured, and written as the paper's tables."""
