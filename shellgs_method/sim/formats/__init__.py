"""Files that simulators load."""
