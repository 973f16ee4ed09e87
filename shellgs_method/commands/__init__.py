"""The commands of `shellgs`, a module each; their imports are inside, since each start of the program pays for them."""
