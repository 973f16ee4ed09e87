"""Which Gaussians there are and when they change."""
