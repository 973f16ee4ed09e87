"""Start runs: here, or on a Ray cluster."""
