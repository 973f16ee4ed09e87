"""A procedural facade with exact geometry, for the demo and the tests."""

from shellgs_method.synthetic.scene import FacadeConfig, settings_of, write_scene

__all__ = ["FacadeConfig", "settings_of", "write_scene"]
