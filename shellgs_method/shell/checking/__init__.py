"""What the photographs say of the shell."""
