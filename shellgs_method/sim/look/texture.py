"""Bake a texture for a mesh from photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import csc_array, hstack
from trimesh.geometry import mean_vertex_normals

from shellgs_method.geometry.camera import Camera, project
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.machine.extras import import_extra

SHARPNESS = 6.0
"""Exponent of the view weights: the best views of a point dominate, yet blend into each other."""
SLACK = 0.05
"""Metres that a point may lie behind the first surface in a view and still count as visible."""
LARGEST = 8192
"""Largest side of a texture in pixels that all graphics cards support."""
FINER = 0.6
"""Size of a texel in pixels of the photographs, which together resolve more than one does."""
GUTTER = 4
"""Padding between the charts of an atlas, in pixels."""
CHUNK = 2_000_000
"""Texels that are computed together: arrays of all would take gigabytes."""


class Photo(NamedTuple):
    """A photograph and its camera, in the frame of the mesh."""

    image: UInt8[np.ndarray, "H W 3"]
    camera: Camera
    mask: np.ndarray | None
    """True where a pixel counts; None if all do."""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with a texture.

    Attributes:
        vertices: vertices in metres, one for each texture coordinate.
        faces: vertex indices.
        uv: texture coordinates in [0, 1], v upwards.
        image: texture.
        seen: share of the vertices that are visible in some photograph.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    uv: Float64[np.ndarray, "V 2"]
    image: Image.Image
    seen: float


def bake(
    surface: Triangles,
    colours: Float64[np.ndarray, "V 3"],
    photos: Callable[[], Iterable[Photo]],
    texel: float | None = None,
) -> TexturedMesh:
    """Unwrap a surface and texture it from photographs, or with its own colours where no photograph sees it.

    A view's weight at a vertex is its pixels per square metre of surface, 0 where the vertex is hidden. Weights are
    raised to a power and interpolated over triangles, so that views blend across the seams between them.

    Args:
        surface: mesh.
        colours: vertex colours in [0, 255].
        photos: gives photographs with cameras in the mesh's frame; it is called twice, and none of them is kept.
        texel: size of the texture's pixels, in metres; a little finer than the photographs' on the mesh if None.
    """
    # Sparse: a photograph of many sees a small part of the surface.
    area_vectors = surface.areas[:, None] * surface.normals
    normals = np.asarray(mean_vertex_normals(len(surface.vertices), surface.faces, area_vectors))
    weights = csc_array(hstack([csc_array(_weights(surface, normals, photo)[:, None]) for photo in photos()]))
    best = weights.max(axis=1).toarray().ravel()
    if texel is None:  # a weight is pixels per square metre
        texel = float(FINER / np.sqrt(np.median(best[best > 0]))) if (best > 0).any() else 0.02
    vertex, uv, faces, size = _atlas(surface, texel)
    corners = vertex[faces]  # the mesh's vertices around each triangle
    places, colours = surface.vertices[corners], colours[corners]
    texels = _Texels.of(uv, faces, size)
    own = 1e-3  # what no photograph sees keeps its own colour, and what hardly any sees blends into it
    total, blend = np.full(len(texels.place), own, np.float32), np.empty((len(texels.place), 3), np.float32)
    for chunk in _chunks(len(blend)):
        blend[chunk] = own * texels.mean(colours, chunk)
    for number, photo in enumerate(photos()):
        sharp = (weights[:, [number]].toarray().ravel() / np.maximum(best, 1e-12)) ** SHARPNESS
        of_corners = sharp[corners]
        there = np.flatnonzero((of_corners > 0).any(axis=1)[texels.triangle])
        for chunk in _chunks(len(there)):
            weight = texels.mean(of_corners, there[chunk])
            seeing, weight = there[chunk][weight > 1e-4], weight[weight > 1e-4]
            total[seeing] += weight
            blend[seeing] += weight[:, None] * _sample(photo, texels.mean(places, seeing))
    blend /= total[:, None]
    texture, known = np.zeros((size[0] * size[1], 3), np.uint8), np.zeros(size, bool)
    texture[texels.place] = blend.round(out=blend).clip(0, 255, out=blend)
    known.ravel()[texels.place] = True
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    filled = texture.reshape(*size, 3)[nearest[0], nearest[1]]
    image = Image.fromarray(filled[::-1])  # its first row is at the top, and v points up
    return TexturedMesh(surface.vertices[vertex], faces, uv, image, float((best > 0).mean()))


def _chunks(count: int) -> Iterator[slice]:
    """Parts of :data:`CHUNK`, in order."""
    return (slice(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK))


def _weights(surface: Triangles, normals: Float64[np.ndarray, "V 3"], photo: Photo) -> Float64[np.ndarray, " V"]:
    """Pixels per square metre of the surface at each vertex in a photograph, 0 where it is not visible."""
    camera, vertices = photo.camera, surface.vertices
    pixels, depth = project(camera, vertices)
    height, width = photo.image.shape[:2]
    edge = np.minimum.reduce([*pixels.T, *([width, height] - pixels).T]) / (0.05 * min(width, height))
    seen = np.flatnonzero((depth > 0.1) & (edge > 0))
    eye = camera.position.double().numpy()
    seen = seen[surface.sees(eye, vertices[seen], SLACK)]
    if photo.mask is not None:
        row, column = np.minimum(pixels[seen][:, ::-1].astype(int), np.array([height, width]) - 1).T
        seen = seen[photo.mask[row, column]]
    away = eye - vertices[seen]
    distance = np.linalg.norm(away, axis=1)
    cosine = np.abs(np.einsum("nc,nc->n", away, normals[seen])) / distance
    weights = np.zeros(len(vertices))
    focal = float(camera.K[0, 0] * camera.K[1, 1])
    weights[seen] = cosine * focal / distance**2 * np.minimum(edge[seen], 1.0)
    # A vertex gets the least weight around it, so that no triangle is partly textured with what hides it.
    lowest = np.full(len(vertices), np.inf)
    least = weights[surface.faces].min(axis=1)
    np.minimum.at(lowest, surface.faces.ravel(), np.repeat(least, 3))
    return np.where(np.isfinite(lowest), lowest, 0.0)


def _sample(photo: Photo, points: Float64[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """The photograph's colours at points, interpolated bilinearly."""
    pixels, _ = project(photo.camera, points)
    where = pixels.T[::-1] - 0.5
    return np.stack(
        [map_coordinates(photo.image[..., k].astype(np.float32), where, order=1, mode="nearest") for k in range(3)], -1
    )


def _atlas(
    surface: Triangles, texel: float
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, "M 2"], Int64[np.ndarray, "F 3"], tuple[int, int]]:
    """For each atlas vertex its mesh vertex and its UV in [0, 1]², the faces, and the texture's height and width."""
    xatlas = import_extra("xatlas", "xatlas", "sim", "a texture")
    size = float(np.sqrt(surface.areas.sum()) / texel)
    atlas = xatlas.Atlas()
    atlas.add_mesh(surface.vertices.astype(np.float32), surface.faces.astype(np.uint32))
    charts, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations, charts.max_cost = 1, 4.0
    pack.padding, pack.bilinear, pack.rotate_charts = GUTTER, True, True
    pack.texels_per_unit = 1 / texel * min(1.0, 0.8 * LARGEST / size)
    atlas.generate(charts, pack)
    vertex, faces, uv = atlas.get_mesh(0)
    return vertex.astype(np.int64), uv.astype(np.float64), faces.astype(np.int64), (atlas.height, atlas.width)


class _Texels(NamedTuple):
    """Texels of an atlas whose centres are in a triangle; of the largest there are 50 million."""

    place: Int32[np.ndarray, " N"]
    """Index into the flattened texture."""
    triangle: Int32[np.ndarray, " N"]
    barycentric: Float32[np.ndarray, "N 3"]
    """The texel's centre in the triangle."""

    @classmethod
    def of(cls, uv: Float[np.ndarray, "M 2"], faces: Int64[np.ndarray, "F 3"], size: tuple[int, int]) -> _Texels:
        """Find the texels of an atlas' faces, of a texture of a height and width."""
        return cls(*map(np.concatenate, zip(*_texels_of(uv * [size[1], size[0]], faces, size), strict=True)))

    def mean(
        self, of_corners: Float64[np.ndarray, "F 3 *C"], some: Int64[np.ndarray, " M"] | slice
    ) -> Float64[np.ndarray, " M *C"]:
        """Values of the triangles' corners, interpolated at some texels."""
        return np.einsum("nk,nk...->n...", self.barycentric[some], of_corners[self.triangle[some]])


def _texels_of(places: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> Iterator[tuple]:
    corners = places[faces]
    low = np.floor(corners.min(axis=1) - 0.5).astype(int).clip(0)
    high = (np.ceil(corners.max(axis=1) + 0.5).astype(int)).clip(max=[size[1], size[0]])
    extent = (high - low).clip(0)
    counts = extent.prod(axis=1)
    ends = np.cumsum(counts)
    starts = ends - counts
    a = corners[:, 0]
    first_edge, second_edge = corners[:, 1] - a, corners[:, 2] - a
    doubled = first_edge[:, 0] * second_edge[:, 1] - first_edge[:, 1] * second_edge[:, 0]
    area = np.where(np.abs(doubled) > 1e-12, doubled, 1e-12)
    for chunk in _chunks(int(ends[-1])):
        number = np.arange(chunk.start, chunk.stop)
        triangle = np.searchsorted(ends, number, side="right")
        within = number - starts[triangle]
        column = low[triangle, 0] + within % extent[triangle, 0]
        row = low[triangle, 1] + within // extent[triangle, 0]
        x, y = column + 0.5 - a[triangle, 0], row + 0.5 - a[triangle, 1]
        v = (x * second_edge[triangle, 1] - y * second_edge[triangle, 0]) / area[triangle]
        w = (first_edge[triangle, 0] * y - first_edge[triangle, 1] * x) / area[triangle]
        weights = np.stack([1 - v - w, v, w], axis=1)
        inside = (weights > -1e-6).all(axis=1)
        place = row * size[1] + column
        yield place[inside].astype(np.int32), triangle[inside].astype(np.int32), weights[inside].astype(np.float32)
