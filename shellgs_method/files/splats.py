"""Gaussians in files for splat viewers: ply, glTF (KHR_gaussian_splatting), spz, and a page for browsers."""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from shellgs_method.errors import SceneError, check_output, notice
from shellgs_method.files.atomic import write_whole
from shellgs_method.files.readers.ply import DEGREE_0
from shellgs_method.files.splats_page import splats_page
from shellgs_method.geometry.camera import Camera

FORMATS: tuple[str, ...] = (".ply", ".glb", ".spz", ".html")
Y_UP = (".glb", ".spz", ".html")
"""Formats whose y axis points up, whatever the scene's does."""
DISCS = "SplatRenderMode: 2dgs"
"""Comment in the ply of discs, by which viewers render them as such."""
LARGEST_PAGE = 300
"""Megabytes: a string has at most 512 in Chromium, and 9 million Gaussians take 1.2 GB of a graphics card."""
BLACK = (0.0, 0.0, 0.0)
"""Background of a page, unless another is given."""
_LARGEST_GLB = 2**32 - 1
"""Bytes of a glb, whose header counts them in 32 bits: some 18 million Gaussians with harmonics of degree 3."""
_EXTENSION = "KHR_gaussian_splatting"
_ELLIPSE = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians with the parameters that are trained; a disc has a third scale of nearly zero.

    Attributes:
        means: centres.
        quats: rotations (w, x, y, z), of any norm.
        scales: logarithms of the standard deviations.
        opacities: logits.
        harmonics: spherical harmonics coefficients of the colours, degree by degree.
        discs: whether they are the discs of 2D Gaussian Splatting.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N 1"]
    harmonics: Float[Tensor, "N K 3"]
    discs: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    def __getitem__(self, chosen: Tensor | slice) -> Splats:
        """Select Gaussians by indices, a mask or a slice."""
        return Splats(*(each[chosen] for each in self._tensors), discs=self.discs)

    @property
    def _tensors(self) -> tuple[Tensor, ...]:
        return self.means, self.quats, self.scales, self.opacities, self.harmonics

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def colours(self) -> Float[Tensor, "N 3"]:
        """Colours from 0 to 1, means over all directions of view."""
        return (0.5 + DEGREE_0 * self.harmonics[:, 0].double()).clamp(0, 1)

    @property
    def is_finite(self) -> Bool[Tensor, " N"]:
        """Which Gaussians have no NaN or infinite value: these break viewers."""
        return torch.stack([each.flatten(1).isfinite().all(dim=1) for each in self._tensors]).all(dim=0)

    @property
    def finite(self) -> Splats:
        """Those that are."""
        return self[self.is_finite]


def check_splats_format(path: Path, discs: bool = False) -> None:
    """Refuse an output that cannot be written, before hours of work.

    Raises:
        SceneError: it is not named as one of the formats, that format has no discs, or the path is not writable.
    """
    check_output(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise SceneError(f"{path}: splats are written as ply, glb, spz or html: name a file that ends in one of these")
    if discs and suffix == ".spz":
        raise SceneError(f"{path}: spz has no discs, which have no thickness: name a .ply, .glb or .html")


def write_splats(
    path: Path,
    splats: Splats,
    comments: Sequence[str] = (),
    views: Sequence[Camera] = (),
    background: Sequence[float] = BLACK,
) -> int:
    """Write the finite ones of some Gaussians in the format that the path's suffix names; return their number.

    Args:
        path: ply (Kerbl et al. 2023), glb with KHR_gaussian_splatting, spz, or html.
        splats: Gaussians; of :data:`Y_UP` formats in a frame whose y axis points up.
        comments: lines that say what the coordinates are, where the format has a place for them.
        views: cameras from which a page shows them.
        background: colour behind them in a page, from 0 to 1.

    Raises:
        SceneError: as :func:`check_splats_format`, or the coordinates are too far from the origin for the format, or a
            page or a glb would be too large.
    """
    splats = splats.finite
    content = encoded(path, splats, comments, views, background)
    if path.suffix.lower() == ".html" and len(content) > 1e6 * LARGEST_PAGE:
        raise SceneError(
            f"{path} would have {len(content) / 1e6:.0f} MB, more than browsers read: give --megabytes {LARGEST_PAGE}"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content)
    return len(splats)


def encoded(
    path: Path,
    splats: Splats,
    comments: Sequence[str] = (),
    views: Sequence[Camera] = (),
    background: Sequence[float] = BLACK,
) -> bytes:
    """Content of the file that :func:`write_splats` writes of finite Gaussians."""
    check_splats_format(path, splats.discs)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return _ply(splats, comments)
    if suffix == ".glb":
        if _bytes_of_glb(splats) > _LARGEST_GLB - 2**16:
            raise SceneError(f"{path} would have more than the 4 GB of a glb: name a .ply")
        return _glb(splats, comments)
    spz = _spz(splats)
    return spz if suffix == ".spz" else splats_page(spz, splats.discs, comments, views, background)


def read_splats(path: Path) -> Splats:
    """Read the ply of 3D Gaussian Splatting.

    Raises:
        FileNotFoundError: there is none.
        SceneError: it is damaged, or no such ply.
    """
    header, found, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    names = [line[2] for line in lines if line[:2] == ["property", "float"]]
    count = next((int(line[2]) for line in lines if line[:2] == ["element", "vertex"] and line[2].isdigit()), 0)
    rest = sum(name.startswith("f_rest_") for name in names)
    if (
        not found
        or rest % 3
        or len(body) != 4 * count * len(names)
        or len(names) != sum(line[:1] == ["property"] for line in lines)
    ):
        raise SceneError(
            f"{path} is damaged, or not a ply of Gaussians in binary floats: write it again by shellgs splats"
        )
    rows = np.frombuffer(body, "<f4").reshape(count, len(names)).copy()
    table = dict(zip(names, torch.from_numpy(rows).T, strict=True))
    wanted = [("x", "y", "z"), *(tuple(f"{name}_{k}" for k in range(n)) for name, n in (("rot", 4), ("scale", 3)))]
    wanted += [("opacity",), tuple(f"f_dc_{k}" for k in range(3)), tuple(f"f_rest_{k}" for k in range(rest))]
    if missing := [name for group in wanted for name in group if name not in table]:
        raise SceneError(f"{path} is not a ply of Gaussians: it has no {missing[0]}")
    means, quats, scales, opacities, first, others = (
        torch.stack([table[name] for name in group], dim=1) if group else torch.zeros(count, 0) for group in wanted
    )
    harmonics = torch.cat([first[:, None], others.reshape(count, 3, rest // 3).transpose(1, 2)], dim=1)
    return Splats(means, quats, scales, opacities, harmonics, discs=["comment", *DISCS.split()] in lines)


def _unit_quats(splats: Splats) -> Tensor:
    return torch.nn.functional.normalize(splats.quats.double(), dim=-1)


def _ply(splats: Splats, comments: Sequence[str]) -> bytes:
    """The ply of 3D Gaussian Splatting: float32, unit quaternions, harmonics by channel.

    Its header is ASCII, since viewers count letters of it, not bytes, to find the data; and its third line counts the
    Gaussians, where the viewer of 3D Gaussian Splatting expects their number.
    """
    rest = splats.harmonics[:, 1:].transpose(1, 2).flatten(1)
    columns = {
        ("x", "y", "z"): splats.means,
        ("nx", "ny", "nz"): torch.zeros_like(splats.means),
        tuple(f"f_dc_{k}" for k in range(3)): splats.harmonics[:, 0],
        tuple(f"f_rest_{k}" for k in range(rest.shape[1])): rest,
        ("opacity",): splats.opacities,
        tuple(f"scale_{k}" for k in range(3)): splats.scales,
        tuple(f"rot_{k}" for k in range(4)): _unit_quats(splats),
    }
    table = torch.cat([part.double() for part in columns.values()], dim=1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"comment {' '.join(each.split())}" for each in ((DISCS,) if splats.discs else ()) + tuple(comments)]
    header += [f"property float {name}" for names in columns for name in names]
    return "\n".join([*header, "end_header", ""]).encode("ascii", "backslashreplace") + table.tobytes()


def _glb(splats: Splats, comments: Sequence[str]) -> bytes:
    """Binary glTF with KHR_gaussian_splatting (ratified): linear scales and opacities, harmonics by coefficient.

    A point cloud of the mean colours where the extension is not known.
    """
    opacities = splats.opacities.double().sigmoid()
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": (255 * torch.cat([splats.colours, opacities], dim=1)).round().to(torch.uint8),
        f"{_EXTENSION}:ROTATION": _unit_quats(splats)[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": splats.scales.double().exp(),
        f"{_EXTENSION}:OPACITY": opacities,
    }
    for degree in range(splats.degree + 1):
        for k in range(2 * degree + 1):
            attributes[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = splats.harmonics[:, degree**2 + k]
    accessors, views, data = [], [], b""
    for values in attributes.values():
        is_bytes = values.dtype == torch.uint8
        array = values.numpy().astype("u1" if is_bytes else "<f4")
        accessors.append(
            {
                "bufferView": len(views),
                "componentType": 5121 if is_bytes else 5126,
                "count": len(array),
                "type": "SCALAR" if array.shape[1] == 1 else f"VEC{array.shape[1]}",
                **({"normalized": True} if is_bytes else {}),
            }
        )
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes()
    means = splats.means.numpy().astype("<f4")
    if len(means):
        accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    primitive = {
        "attributes": dict(zip(attributes, range(len(attributes)), strict=True)),
        "mode": 0,
        "extensions": {_EXTENSION: _ELLIPSE},
    }
    document = {
        "asset": {"version": "2.0", "generator": "ShellGS", "extras": {"comments": list(comments)}},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    chunks = b""
    for kind, content, padding in ((b"JSON", json.dumps(document).encode(), b" "), (b"BIN\0", data, b"\0")):
        content += padding * (-len(content) % 4)
        chunks += struct.pack("<I4s", len(content), kind) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _bytes_of_glb(splats: Splats) -> int:
    """Bytes of a glb, without those that do not depend on the number of Gaussians."""
    return len(splats) * (4 * (3 + 4 + 3 + 1) + 4 + 12 * splats.harmonics.shape[1])


SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 3
SPZ_COLOUR = 0.15
"""Factor of coefficients of degree 0 in spz, which bytes then hold with some room."""
SPZ_LARGEST = 255 / 16 - 10
"""Logarithm of the largest standard deviation in spz."""
SPZ_BITS = 6
"""Significant bits of the coefficients above degree 0; the others are zero, for gzip. The 5, 4 and 4 of Niantic's
encoder for degrees 1 to 3 save up to a quarter, but trained coefficients are as small as their steps: a run was 35 dB
from what was written, and is 46 with 6."""


def _spz(splats: Splats) -> bytes:
    """Niantic's spz, version 3: fixed-point positions of 24 bits, all else in bytes, rotations in 32 bits, gzipped."""
    most = float(splats.means.abs().max()) if len(splats) else 0.0
    fraction = int(np.clip(22 - math.ceil(math.log2(max(most, 1e-6))), 0, 20))  # bits after the point
    if most * 2**fraction >= 2**23:
        raise SceneError(f"the splats reach {most:.0f} from the origin, too far for spz: name a .ply or .glb")
    if cut := int((splats.scales > SPZ_LARGEST).any(dim=1).sum()):
        notice(
            f"{cut} Gaussians have standard deviations of more than {math.exp(SPZ_LARGEST):.0f} units, which spz and "
            "pages cannot hold, and are cut to that: a .ply or .glb keeps them."
        )
    fixed = (splats.means.double() * 2**fraction).round().int().numpy().astype("<i4")
    positions = fixed.view("u1").reshape(len(fixed), 3, 4)[:, :, :3]
    harmonics = splats.harmonics.double().numpy()
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(splats), splats.degree, fraction, 0, 0)
    parts = (
        positions,
        _bytes(255 * splats.opacities.double().sigmoid().numpy()),
        _bytes(255 * (SPZ_COLOUR * harmonics[:, 0] + 0.5)),
        _bytes(16 * (splats.scales.double().numpy() + 10)),
        _smallest_three(_unit_quats(splats).numpy()),
        _quantised(harmonics[:, 1:]),
    )
    return gzip.compress(header + b"".join(part.tobytes() for part in parts), mtime=0)


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return values.round().clip(0, 255).astype(np.uint8)


def _quantised(harmonics: Float[np.ndarray, "N K 3"]) -> UInt8[np.ndarray, "N K 3"]:
    """Coefficients in [-1, 1] as bytes around 128, to the nearest of those that have so many bits."""
    step = 2 ** (8 - SPZ_BITS)
    return _bytes((np.round(harmonics * 128 / step) * step + 128).clip(0, 255))


def _smallest_three(quats: Float[np.ndarray, "N 4"]) -> np.ndarray:
    """Unit quaternions in 32 bits: which of (x, y, z, w) is largest, and sign and size of the others in 10 each."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    others = np.array([[j for j in range(4) if j != k] for k in range(4)])[largest]
    rest = np.take_along_axis(xyzw, others, axis=1)
    negative = (rest < 0) ^ (np.take_along_axis(xyzw, largest[:, None], axis=1) < 0)
    sizes = (np.abs(rest) * math.sqrt(2) * 511 + 0.5).astype(np.uint32).clip(0, 511)
    packed = largest.astype(np.uint32)
    for k in range(3):
        packed = packed << np.uint32(10) | negative[:, k].astype(np.uint32) << np.uint32(9) | sizes[:, k]
    return packed.astype("<u4")
