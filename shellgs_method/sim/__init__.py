"""A building that simulators load: colliders, a textured look and splats in one frame, and trials in MuJoCo.

:mod:`shellgs_method.sim.simulate` and :mod:`shellgs_method.sim.building` take trained runs; everything else is plain
numpy, Open3D and the libraries of the extra ``sim``.
"""
