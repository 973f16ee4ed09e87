"""Shell geometry: files, point clouds, meshes and ray casting."""
