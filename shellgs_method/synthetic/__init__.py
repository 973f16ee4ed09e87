"""A procedural facade with exact geometry, for the demo and the tests."""

from shellgs_method.synthetic.scene import FacadeConfig, write_scene

__all__ = ["FacadeConfig", "write_scene"]
