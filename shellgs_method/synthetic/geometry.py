"""Triangle meshes with materials, and the basic solids of the building and the street."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import trimesh
from jaxtyping import Float, Float64, Int

from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.triangles import stacked


class Material(IntEnum):
    """Material of a triangle; the building's materials come first, up to ``RAILING``."""

    WALL = 0
    COLUMN = 1
    SLAB = 2
    DOOR = 3
    GLASS = 4
    FRAME = 5
    FLOWERS = 6
    RAILING = 7
    GROUND = 8
    POLE = 9
    TRUNK = 10
    LEAF = 11
    HOUSE = 12
    CAR = 13
    COURT = 14


@dataclass(frozen=True)
class Mesh:
    """A triangle soup.

    Attributes:
        vertices: positions in metres.
        triangles: three vertex indices each, counter-clockwise seen from outside.
        material: one :class:`Material` per triangle.
    """

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]
    material: Int[np.ndarray, " F"]


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Merge meshes into one."""
    meshes = list(meshes)
    return Mesh(
        *stacked((mesh.vertices, mesh.triangles) for mesh in meshes),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def moved(mesh: Mesh, motion: Float64[np.ndarray, "4 4"]) -> Mesh:
    """A mesh after a rigid motion."""
    return replace(mesh, vertices=transformed(mesh.vertices, motion))


def parallelogram(corner: Sequence[float], a: Sequence[float], b: Sequence[float], material: Material) -> Mesh:
    """The parallelogram spanned by ``a`` and ``b`` from ``corner``; its normal points along ``a × b``."""
    vertices = np.array(corner, dtype=np.float64) + np.stack([np.zeros(3), a, np.add(a, b), b])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, material))


def box(low: Sequence[float], high: Sequence[float], material: Material) -> Mesh:
    """The axis-aligned box between two corners."""
    return _with_material(trimesh.creation.box(bounds=[low, high]), material)


def cylinder(foot: Sequence[float], radius: float, height: float, material: Material) -> Mesh:
    """An upright cylinder on ``foot``."""
    solid = trimesh.creation.cylinder(radius=radius, height=height, sections=20)
    return _with_material(solid.apply_translation(np.add(foot, (0.0, 0.0, height / 2))), material)


def _with_material(solid: trimesh.Trimesh, material: Material) -> Mesh:
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces), np.full(len(solid.faces), material))
