"""Whether an alignment can be trusted."""
