"""Gaussians before a camera, and what it sees; glTF and spz files of Gaussians, decoded as specified."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from cameras import pinhole

from shellgs_method.files.splats import Splats
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.maps import DISC_LOG_THICKNESS
from shellgs_method.render.view import ViewRenderer

CAMERA = pinhole(90, 160, 120, dtype=torch.float32)


def some(count: int = 400, degree: int = 3, *, discs: bool = False) -> Splats:
    """Gaussians before the camera."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([6.0, 4, 4]) + torch.tensor([-3.0, -2, 4])
    scales = torch.randn(count, 3, generator=generator) * 0.5 - 2
    if discs:
        scales[:, 2] = DISC_LOG_THICKNESS
    harmonics = torch.randn(count, (degree + 1) ** 2, 3, generator=generator) * 0.1
    harmonics[:, 0] *= 8
    quats, opacities = (torch.randn(count, n, generator=generator) for n in (4, 1))
    return Splats(means, quats, scales, opacities, harmonics, discs=discs)


def image(splats: Splats, camera: Camera = CAMERA, background: Sequence[float] = (0, 0, 0)) -> torch.Tensor:
    """What a camera sees of Gaussians."""
    gaussians = {
        "means": splats.means.float(),
        "quats": splats.quats.float(),
        "scales": splats.scales.float(),
        "opacities": splats.opacities.float(),
        "features_dc": splats.harmonics[:, 0].float(),
        "features_rest": splats.harmonics[:, 1:].float(),
    }
    renderer = ViewRenderer("2d" if splats.discs else "3d", "expected")
    return renderer(gaussians, camera, torch.tensor(background).float(), splats.degree, False, False)[0].clamp(0, 1)


def psnr(one: Splats, other: Splats) -> float:
    """Of what the camera sees of the one and of the other."""
    return float(-10 * (image(one) - image(other)).square().mean().log10())


def glb_attributes(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """The document of a binary glTF, and the attributes of its primitive."""
    content = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack("<I4s", content[12:20])
    assert (kind, size % 4) == (b"JSON", 0)
    document, data = json.loads(content[20 : 20 + size]), content[28 + size :]
    attributes = {}
    for name, number in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5121: "u1", 5126: "<f4"}[accessor["componentType"]]
        values = np.frombuffer(data[view.get("byteOffset", 0) :][: view["byteLength"]], kind)
        attributes[name] = values.reshape(accessor["count"], -1)
    return document, attributes


def unpacked(path: Path) -> Splats:
    """Gaussians of an spz of version 3, as its documentation has it."""
    content = gzip.decompress(path.read_bytes())
    magic, version, count, degree, fraction, flags, reserved = struct.unpack("<IIIBBBB", content[:16])
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    sizes = 9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)
    assert len(content) == 16 + count * sum(sizes)
    parts = np.split(np.frombuffer(content[16:], np.uint8), count * np.cumsum(sizes)[:-1])
    positions, opacities, colours, scales, packed, rest = (
        part.reshape(count, size) for part, size in zip(parts, sizes, strict=True)
    )
    fixed = positions.reshape(count, 3, 3).astype(np.int32) @ np.array([1, 1 << 8, 1 << 16])
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed)
    quats = np.zeros((count, 4))
    for row, word in zip(quats, packed.copy().view("<u4")[:, 0].tolist(), strict=True):
        largest = word >> 30
        others = [k for k in range(4) if k != largest]
        for k, shift in zip(others, (20, 10, 0), strict=True):
            bits = word >> shift & 1023
            row[k] = (-1 if bits & 512 else 1) * (bits & 511) / 511 / np.sqrt(2)
        row[largest] = np.sqrt(1 - (row**2).sum())
    alpha = torch.from_numpy(opacities / 255).clamp(1e-4, 1 - 1e-4)
    harmonics = np.concatenate(
        [((colours / 255 - 0.5) / 0.15)[:, None], (rest.reshape(count, -1, 3).astype(float) - 128) / 128], axis=1
    )
    fields = fixed / 2**fraction, quats[:, [3, 0, 1, 2]], scales / 16 - 10, torch.logit(alpha), harmonics
    return Splats(*(torch.as_tensor(np.asarray(each)).float() for each in fields))


def of_glb(path: Path) -> Splats:
    """Gaussians of a glTF."""
    _, attributes = glb_attributes(path)
    own = {name.split(":")[1]: torch.from_numpy(values.copy()) for name, values in attributes.items() if ":" in name}
    harmonics = torch.stack([values for name, values in own.items() if name.startswith("SH")], dim=1)
    quats = own["ROTATION"][:, [3, 0, 1, 2]]
    means = torch.from_numpy(attributes["POSITION"].copy())
    return Splats(means, quats, own["SCALE"].log(), torch.logit(own["OPACITY"]), harmonics)
