"""Read OBJ, STL and OFF: trimesh loses what follows a cut, and takes negative indices of OBJ from the file's end."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.readers.contents import (
    NO_POINTS,
    Geometry,
    drawing,
    encoding_of,
    left_out,
    numbers_in,
    polygon_triangles,
    with_nan,
)

_CURVED = ("curv", "surf", "bsp", "bzp", "cdc", "cdp", "res ")


def read_obj(path: Path) -> Geometry:
    """Read the vertices and faces of a Wavefront OBJ; without faces, its vertices are a cloud.

    Raises:
        SceneError: it holds lines only.
        Exception: it is damaged; of any kind.
    """
    text = path.read_text(encoding_of(path), errors="replace").replace("\\\n", " ")
    vertices: list[str] = []
    faces: list[str] = []
    above: list[int] = []  # number of vertices before each face
    curved = lines = 0
    for line in map(str.lstrip, text.splitlines()):
        key = line[:2].rstrip().lower()
        if key == "v":
            vertices.append(line)
        elif key in ("f", "fo"):
            faces.append(line.partition("#")[0].lstrip("fFoO"))
            above.append(len(vertices))
        elif key == "l":
            lines += 1
        elif line.startswith(_CURVED):
            curved += 1
    left_out(path, curved, curved + len(faces), "elements, which are curves or curved surfaces")
    if lines and not faces:
        raise drawing(path)
    points = np.loadtxt(map(with_nan, vertices), usecols=(1, 2, 3), ndmin=2) if vertices else NO_POINTS
    sizes = np.array([len(face.split()) for face in faces], np.int64)
    stored = numbers_in(re.sub(r"/\S*", "", " ".join(faces)), int)
    ends, of = np.unique(np.array(above, np.int64), return_inverse=True)  # of blocks of vertices, and each face's
    starts = np.concatenate([[0], ends])
    end, start = (np.repeat(some[of], sizes) for some in (ends, starts))
    corners = np.where(stored > 0, stored - 1, stored + end)
    # Counted on, blocks would have vertices of no face, and faces those of other blocks.
    if ((stored > 0) & (stored <= end - start)).all() and (stored <= start).any():
        notice(f"{path}: its faces count vertices from 1 in each of its {len(ends)} objects, and are read so.")
        corners += start
    if (stored == 0).any() or (corners < 0).any():  # counted from 1, or backwards from the last vertex before the face
        raise ValueError("a face has a vertex before the first")
    return Geometry(points, polygon_triangles(points, sizes, corners, path))


_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_START, _STL_PROBE = 84, 1 << 12  # bytes: the header's; in which a binary STL has a zero
_UNCOUNTED = (0, 0xFFFFFFFF)


def read_stl(path: Path) -> Geometry:
    """Read the triangles of a binary or an ASCII STL, of all its solids.

    A binary one whose header does not count its triangles, as of programs that write them as they come, is read whole.

    Raises:
        ValueError: it is cut off or damaged.
    """
    data, encoding = path.read_bytes(), encoding_of(path)
    if b"\0" in data[:_STL_PROBE] and encoding != "utf-16":  # other text has none
        return _binary_stl(path, data)
    words = [line.split() for line in with_nan(data.decode(encoding, errors="replace")).lower().splitlines()]
    solids, facets = (sum(line[:1] == [word] for line in words) for word in ("solid", "facet"))
    ends = sum("".join(line[:2]).startswith("endsolid") for line in words)  # end solid NAME, endsolidNAME
    if not solids:
        raise ValueError("it is neither a binary STL nor one of text")
    corners = np.array([line[1:4] for line in words if line[:1] == ["vertex"]], np.float64).reshape(-1, 3)
    if solids != ends or len(corners) != 3 * facets:
        raise ValueError(f"it holds {len(corners)} corners of {facets} triangles, and {ends} ends of {solids} solids")
    return _soup(corners.reshape(-1, 3, 3))


def _binary_stl(path: Path, data: bytes) -> Geometry:
    claimed = int.from_bytes(data[80:_STL_START], "little")
    there, rest = divmod(max(0, len(data) - _STL_START), _STL.itemsize)
    if claimed in _UNCOUNTED and there and not rest:
        notice(f"{path}: its header does not count its triangles: the {there} that follow are read.")
        claimed = there
    end = _STL_START + claimed * _STL.itemsize
    if end > len(data):
        raise ValueError(f"its header claims {claimed} triangles, but it has {len(data)} bytes")
    if data[end:].strip(b"\0 \r\n"):
        raise ValueError(
            f"it continues for {len(data) - end} bytes after the {claimed} triangles that its header claims"
        )
    return _soup(np.frombuffer(data, _STL, claimed, _STL_START)["corners"].astype(np.float64))


def _soup(corners: Float64[np.ndarray, "F 3 3"]) -> Geometry:
    return Geometry(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def read_off(path: Path) -> Geometry:
    """Read the vertices and faces of an OFF; colours, normals and texture coordinates may be there.

    Raises:
        SceneError: it is binary, or has other than three coordinates.
        Exception: it is damaged; of any kind.
    """
    text = re.sub(r"#.*", "", with_nan(path.read_text(encoding_of(path), errors="replace")))
    form, _, rest = text.lstrip().partition("OFF")
    if not re.fullmatch(r"(ST)?C?N?", form) or re.match(r"\s+BINARY", rest):
        raise SceneError(f"the shell {path} is not an OFF of text with three coordinates: export it as PLY or OBJ")
    lines = [line.split() for line in rest.splitlines() if line.strip()]
    vertex_count, face_count = (int(word) for word in lines[0][:2])
    vertices, faces = lines[1 : 1 + vertex_count], lines[1 + vertex_count : 1 + vertex_count + face_count]
    if (len(vertices), len(faces)) != (vertex_count, face_count):
        raise ValueError(f"it holds {len(vertices)} of {vertex_count} vertices and {len(faces)} of {face_count} faces")
    points = np.array([line[:3] for line in vertices], np.float64).reshape(-1, 3)
    sizes = np.array([int(line[0]) for line in faces], np.int64)
    corners = [line[1 : 1 + size] for line, size in zip(faces, sizes, strict=True)]
    if any(len(row) != size for row, size in zip(corners, sizes, strict=True)):
        raise ValueError("a face has fewer corners than it claims")
    return Geometry(points, polygon_triangles(points, sizes, np.array(list(chain(*corners)), np.int64), path))
