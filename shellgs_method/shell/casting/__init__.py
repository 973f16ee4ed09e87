"""What each camera sees of the shell."""
