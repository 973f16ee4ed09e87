"""Plain geometry of the world: cameras, similarities, planes, triangles, nearest points, voxels."""
