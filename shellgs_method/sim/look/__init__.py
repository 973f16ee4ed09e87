"""What a building looks like: texture, visual mesh, renders."""
