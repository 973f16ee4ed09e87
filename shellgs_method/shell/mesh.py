"""A shell's triangles, of one file or of several in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from trimesh.intersections import slice_faces_plane

from shellgs_method.errors import SceneError, notice
from shellgs_method.geometry.precision import NO_STEP, Step
from shellgs_method.geometry.surface_classes import NO_CLASSES, classes_of
from shellgs_method.geometry.triangles import area_vectors, stacked
from shellgs_method.shell.clouds import Meshing

NO_SOURCES = np.empty(0, np.int64)
_TOO_FAR = 1000.0
"""Metres between two files of one shell: cameras see no building at both ends."""
_LARGER = 200.0
"""Ratio of the sizes of two files from which they may be in different units: a millimetre is a thousandth."""


@dataclass(frozen=True)
class ShellMesh:
    """A triangle mesh with at least one triangle, finite vertices and indices in range.

    Attributes:
        vertices: positions in the shell's own frame and units, possibly georeferenced.
        faces: three vertex indices per triangle.
        meshing: how each of the point clouds among its files was meshed.
        step: step of the coordinates in the file.
        classes: :class:`~shellgs_method.geometry.surface_classes.SurfaceClass` of each triangle; OTHER if not given.
        source: number of the file that each triangle is of; that of the first if not given.

    Raises:
        SceneError: the arrays are not such a mesh.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    meshing: tuple[Meshing, ...] = ()
    step: Step = NO_STEP
    classes: UInt8[np.ndarray, " F"] = field(default_factory=NO_CLASSES.copy)
    source: Int64[np.ndarray, " F"] = field(default_factory=NO_SOURCES.copy)

    def __post_init__(self) -> None:
        """Check what Open3D does not, which accepts indices out of range, and fill in classes and sources."""
        object.__setattr__(self, "classes", classes_of(self.faces, self.classes))
        object.__setattr__(self, "source", sources_of(self.faces, self.source))
        if len(self.faces) == 0:
            raise SceneError("the shell has no triangles")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise SceneError(f"the shell's triangles have vertex indices outside its {len(self.vertices)} vertices")
        if not np.isfinite(self.vertices).all():
            raise SceneError("the shell has NaN or infinite vertices")
        if without_area(self.vertices, self.faces).all():
            raise SceneError("all triangles of the shell are degenerate: their areas are 0")

    @property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest corner of the bounding box."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def centre(self) -> Float64[np.ndarray, " 3"]:
        """Median vertex; float32 values are relative to it, so that a distant vertex does not cost precision."""
        return np.median(self.vertices, axis=0)

    def above(self, normal: Float64[np.ndarray, " 3"], offset: float) -> ShellMesh:
        """The part where ``normal · x >= offset``, of a unit normal; triangles across that plane are cut.

        Raises:
            SceneError: there is none.
        """
        kinds, kind = np.unique(np.stack([self.classes, self.source], axis=1), axis=0, return_inverse=True)
        parts = []
        for number in range(len(kinds)):
            of_kind = self.faces[kind.ravel() == number]
            parts.append(slice_faces_plane(self.vertices, of_kind, normal, offset * normal)[:2])
        vertices, faces = stacked(parts)
        kept = ~without_area(vertices, faces)
        classes, source = np.repeat(kinds, [len(each) for _, each in parts], axis=0)[kept].T
        return ShellMesh(vertices, faces[kept], self.meshing, self.step, classes.astype(np.uint8), source)


def sources_of(faces: Int64[np.ndarray, "F 3"], sources: Int64[np.ndarray, " S"]) -> Int64[np.ndarray, " F"]:
    """The numbers of triangles' files, if given, else that of the first for each."""
    return sources if len(sources) else np.zeros(len(faces), np.int64)


def without_area(vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Mask of the triangles that have no area in single precision, in which rays are cast and distances measured.

    Their normals are not defined, and their points nearest to another are NaN. Their heights are within the rounding of
    their own corners, relative to the median vertex, so that a distant vertex does not make other triangles flat.
    """
    placed = (vertices - np.median(vertices, axis=0)).astype(np.float32)
    step = np.spacing(np.abs(placed[faces]).max(axis=(1, 2))).astype(np.float64)
    placed = placed.astype(np.float64)
    a, b, c = placed[faces].transpose(1, 0, 2)
    longest = np.sqrt(np.max([((a - b) ** 2).sum(1), ((b - c) ** 2).sum(1), ((c - a) ** 2).sum(1)], axis=0))
    return np.linalg.norm(area_vectors(placed, faces), axis=1) <= step * longest  # area = height * longest / 2


def joined(meshes: Sequence[ShellMesh], paths: Sequence[Path], metres_per_unit: float = 1.0) -> ShellMesh:
    """Join the meshes of a shell's files, which are in one frame; the user is warned if that is unlikely.

    Args:
        meshes: mesh of each file.
        paths: the files.
        metres_per_unit: 1 for a shell in metres.

    Raises:
        SceneError: a file is kilometres from all others.
    """
    if len(meshes) == 1:
        return meshes[0]
    _check_frame([mesh.bounds for mesh in meshes], paths, metres_per_unit)
    return ShellMesh(
        *stacked((mesh.vertices, mesh.faces) for mesh in meshes),
        tuple(meshing for mesh in meshes for meshing in mesh.meshing),
        max((mesh.step for mesh in meshes), key=lambda step: (step.rounded * step.coarsest, step.coarsest)),
        np.concatenate([mesh.classes for mesh in meshes]),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
    )


def _check_frame(boxes: Sequence[Float64[np.ndarray, "2 3"]], paths: Sequence[Path], metres_per_unit: float) -> None:
    """Refuse a file that is kilometres from the others; report one that stands alone or has another size."""
    low, high = np.stack(boxes, axis=1)
    sizes = np.linalg.norm(high - low, axis=1)
    gaps = np.linalg.norm(np.maximum(low[:, None] - high, 0) + np.maximum(low - high[:, None], 0), axis=2)
    np.fill_diagonal(gaps, np.inf)
    k = int(gaps.min(axis=1).argmax())
    other, largest, smallest = int(gaps[k].argmin()), int(sizes.argmax()), int(sizes.argmin())
    gap = metres_per_unit * gaps[k, other]
    if gap > _TOO_FAR:
        raise SceneError(
            f"{paths[k]} and {paths[other]} are {gap / 1000:.3g} km apart, and cannot be one shell: export all of its "
            "files in the same coordinates and the same unit"
        )
    if gaps[k, other] > sizes[k] + sizes[other]:
        notice(
            f"{paths[k]} stands alone, {gap:.3g} m from {paths[other]}: are the shell's files in the same coordinates? "
            "They are taken to be."
        )
    if len({path.suffix.lower() in (".glb", ".gltf") for path in paths}) == 2:
        notice(
            f"{paths[0]} and others: glTF is y-up by its format, other files rarely are. They are taken as they are."
        )
    if sizes[largest] > _LARGER * sizes[smallest]:
        notice(
            f"{paths[largest]} is {sizes[largest] / sizes[smallest]:.0f} times as large as {paths[smallest]}: are the "
            "shell's files in the same unit? They are taken to be."
        )
