"""Cast the shell into each camera."""
