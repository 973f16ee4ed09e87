"""The commands of `shellgs`, one module each; slow imports are inside the functions, to keep every start fast."""
