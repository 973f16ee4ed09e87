"""Formats on disk: cue maps, cameras, clouds, meshes, photographs; read with checks, written atomically."""
