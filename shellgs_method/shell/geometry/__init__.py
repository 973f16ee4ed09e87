"""The shell itself: files, point clouds, triangles, rays."""
