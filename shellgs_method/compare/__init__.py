"""Methods, seeds and scenes side by side: a grid of runs, launched, measured, and written as the paper's tables."""
