"""A procedural facade, or a street of them, with exact geometry, for the demo, the tests and benchmarks."""

from shellgs_method.synthetic.houses import StreetConfig
from shellgs_method.synthetic.scene import FacadeConfig, settings_of, write_scene

__all__ = ["FacadeConfig", "StreetConfig", "settings_of", "write_scene"]
