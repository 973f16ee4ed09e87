"""Write Gaussians to a ply for splat viewers, in any frame related to theirs by a similarity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from shellgs_method.errors import SceneError, check_output
from shellgs_method.files.atomic import atomic_write
from shellgs_method.geometry.similarity import scale_of
from shellgs_method.render.rasterizer import spherical_harmonics


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians with the parameters that are trained; a disc has a third scale of nearly zero.

    Attributes:
        means: centres.
        quats: rotations (w, x, y, z), of any norm.
        scales: logarithms of the standard deviations.
        opacities: logits.
        harmonics: spherical harmonics coefficients of the colours, degree by degree.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N 1"]
    harmonics: Float[Tensor, "N K 3"]

    def transformed(self, similarity: Float64[np.ndarray, "4 4"]) -> Splats:
        """Apply a similarity to the Gaussians, in float64.

        The harmonics rotate with the Gaussians, so that renders stay the same.
        """
        scale = scale_of(similarity)
        rotation = similarity[:3, :3] / scale
        turned = Rotation.from_matrix(rotation) * Rotation.from_quat(self.quats.double().numpy()[:, [1, 2, 3, 0]])
        bands = harmonics_rotation(torch.from_numpy(rotation), math.isqrt(self.harmonics.shape[1]) - 1)
        return Splats(
            self.means.double() @ torch.from_numpy(similarity[:3, :3].T) + torch.from_numpy(similarity[:3, 3]),
            torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]),
            self.scales.double() + math.log(scale),
            self.opacities,
            torch.einsum("kj,njc->nkc", bands, self.harmonics.double()),
        )


def harmonics_rotation(rotation: Float64[Tensor, "3 3"], degree: int) -> Float64[Tensor, "K K"]:
    """The matrix D that rotates harmonics coefficients c by R: Y(d) D c = Y(Rᵀ d) c for every direction d.

    A rotation maps the harmonics of each degree to each other, so that Y(d) D = Y(Rᵀ d) has an exact solution, found
    by least squares from more directions than unknowns.
    """
    count = (degree + 1) ** 2
    directions = torch.randn(16 * count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    each = torch.eye(count, dtype=torch.float64).expand(len(directions), count, count)
    turned = spherical_harmonics(degree, directions @ rotation, each)
    return torch.linalg.lstsq(spherical_harmonics(degree, directions, each), turned).solution


def check_splats_format(path: Path) -> None:
    """Refuse an output that cannot be written, before hours of work.

    Raises:
        SceneError: it is not named as a ply, or the path is not writable.
    """
    check_output(path)
    if path.suffix.lower() != ".ply":
        raise SceneError(f"{path}: splats are written as ply: name a file that ends in .ply")


def write_splats(path: Path, splats: Splats) -> int:
    """Write the ply of 3D Gaussian Splatting (Kerbl et al. 2023): float32, unit quaternions, harmonics by channel.

    Gaussians with a NaN or infinite value, which break viewers, are left out. Returns the number written.
    """
    rest = splats.harmonics[:, 1:].transpose(1, 2).flatten(1)
    columns = {
        ("x", "y", "z"): splats.means,
        ("nx", "ny", "nz"): torch.zeros_like(splats.means),
        tuple(f"f_dc_{k}" for k in range(3)): splats.harmonics[:, 0],
        tuple(f"f_rest_{k}" for k in range(rest.shape[1])): rest,
        ("opacity",): splats.opacities,
        tuple(f"scale_{k}" for k in range(3)): splats.scales,
        tuple(f"rot_{k}" for k in range(4)): torch.nn.functional.normalize(splats.quats, dim=-1),
    }
    table = torch.cat([part.double() for part in columns.values()], dim=1)
    table = table[table.isfinite().all(dim=1)].numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for names in columns for name in names]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write("\n".join([*header, "end_header", ""]).encode() + table.tobytes())
    return len(table)
