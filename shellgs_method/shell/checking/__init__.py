"""Check the shell against the photographs."""
