"""What comes out of runs: meshes and splats, in metres if the scene has a shell."""
