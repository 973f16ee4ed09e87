"""Export buildings to simulators: collision geometry, a textured mesh and splats in one frame, tested in MuJoCo.

:mod:`shellgs_method.sim.simulate` and :mod:`shellgs_method.sim.building` work on trained runs; everything else is
plain numpy, Open3D and the libraries of the extra ``sim``.
"""
