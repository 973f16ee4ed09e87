"""Project 3D Gaussians to the screen by the EWA approximation, with the conventions of gsplat."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.compilation import run_fused
from shellgs_method.render.rasterizer.binning import touches

NEAR_PLANE = 0.01
LOW_PASS = 0.3  # variance in px² added to every splat
ALPHA_MIN = 1 / 255  # smaller alphas do not count
ALPHA_MAX = 0.999


@dataclass(frozen=True)
class Projection:
    """Splats on the screens of B cameras.

    Attributes:
        means2d: centres in pixels.
        shapes: shape parameters of the primitive's kernels.
        depths: z of the centres in the camera frame.
        outlines: O ellipses (see :mod:`~.binning`) that together cover the pixels where alpha reaches 1/255.
        covars2d: covariances (xx, xy, yy) in px², low-pass included.
        visible: whether beyond the near plane with an outline that touches the image.
        probe: if requested, a leaf with the values of ``means2d`` on which ``probed`` alone depends.
        probed: centres, and the shape parameters that depend on them, computed from the probe.
    """

    means2d: Float[Tensor, "B N 2"]
    shapes: Float[Tensor, "B N K"]
    depths: Float[Tensor, "B N"]
    outlines: Float[Tensor, "B N O 7"]
    covars2d: Float[Tensor, "B N 3"]
    visible: Bool[Tensor, "B N"]
    probe: Float[Tensor, "B N 2"] | None = None
    probed: Float[Tensor, "B N 2+k"] | None = None

    def views(self) -> Iterator[View]:
        """Iterate over the cameras."""
        parts = (self.means2d, self.shapes, self.depths, self.outlines, self.visible)
        # The gradient of unbind is a stack; that of indexing would fill a whole batch for each view.
        probed = [None] * len(self.means2d) if self.probed is None else self.probed.unbind(0)
        return (View(*view) for view in zip(*(part.unbind(0) for part in parts), probed, strict=True))


class View(NamedTuple):
    """Splats on the screen of one camera, see :class:`Projection`."""

    means2d: Float[Tensor, "N 2"]
    shapes: Float[Tensor, "N K"]
    depths: Float[Tensor, "N"]
    outlines: Float[Tensor, "N O 7"]
    visible: Bool[Tensor, "N"]
    probed: Float[Tensor, "N 2+k"] | None


def project_gaussians(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    cameras: Sequence[Camera],
    with_probe: bool = False,
) -> Projection:
    """Project Gaussians (EWA splatting, Zwicker et al. 2001); means2d and shapes are differentiable.

    The shapes are a, b, c and n of the exponent a dx² + b dx dy + c dy² + n, see :func:`halvings`; none depends on the
    screen position of the centre.
    """
    projected = run_fused(_project, means, quats, scales, opacities, *stack_cameras(cameras), strided=True)
    probe = projected[0].detach().requires_grad_() if with_probe else None
    return Projection(*projected, probe=probe, probed=probe)


def _project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    viewmats: Float[Tensor, "B 4 4"],
    intrinsics: Float[Tensor, "B 4 1"],
    size: Float[Tensor, "1 2"],
) -> tuple[Tensor, ...]:
    fx, fy, cx, cy = intrinsics.unbind(1)
    x, y, z = to_camera(means, viewmats)
    depths = z.detach()
    in_front = depths >= NEAR_PLANE
    z = torch.where(in_front, z, 1.0)  # a culled splat must not put a division by 0 into the gradients
    x, y = x / z, y / z
    means2d = torch.stack([fx * x + cx, fy * y + cy], dim=-1)

    # Far off screen the linearised projection diverges: clamp its slope to 15 % of the image beyond the borders.
    width, height = size.unbind(-1)
    x = torch.minimum(torch.maximum(x, -(cx + 0.15 * width) / fx), (1.15 * width - cx) / fx)
    y = torch.minimum(torch.maximum(y, -(cy + 0.15 * height) / fy), (1.15 * height - cy) / fy)
    axes = zip(rotated_axes(quats), scales.unbind(1), strict=True)
    half_axes = [rotate([scale * each for each in axis], viewmats) for axis, scale in axes]
    across = [fx / z * (axis[0] - x * axis[2]) for axis in half_axes]
    down = [fy / z * (axis[1] - y * axis[2]) for axis in half_axes]

    xx, xy, yy = dot(across, across), dot(across, down), dot(down, down)
    # xx yy - xy², by Lagrange's identity: no cancellation for a long and thin splat
    area = cross(across, down)
    determinant = dot(area, area) + LOW_PASS * (xx + yy) + LOW_PASS**2
    xx, yy = xx + LOW_PASS, yy + LOW_PASS
    n = halvings(opacities).expand_as(depths)
    halving = math.log(2) * determinant
    shapes = torch.stack([0.5 * yy / halving, -xy / halving, 0.5 * xx / halving, n], dim=-1)

    xx, xy, yy, determinant = xx.detach(), xy.detach(), yy.detach(), determinant.detach()
    cutoff = cutoffs(opacities)
    extent, reach = cutoff * determinant, [(cutoff * xx).sqrt(), (cutoff * yy).sqrt()]
    outline = torch.stack([*means2d.detach().unbind(-1), yy / extent, -xy / extent, xx / extent, *reach], dim=-1)
    # The ellipse of a splat too large for single precision is NaN.
    visible = in_front & (cutoff > 0) & extent.isfinite() & touches(outline, size)
    return means2d, shapes, depths, outline[..., None, :], torch.stack([xx, xy, yy], dim=-1), visible


def three_sigmas(covars2d: Float[Tensor, "B N 3"], visible: Bool[Tensor, "B N"]) -> Int[Tensor, "B N"]:
    """Radii of splats, see :class:`~.renders.Renders`, from their covariances (xx, xy, yy) in px²."""
    xx, xy, yy = covars2d.unbind(-1)
    variance = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()
    return torch.where(visible, (3 * variance.sqrt()).ceil(), 0).int()


def stack_cameras(
    cameras: Sequence[Camera],
) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B 4 1"], Float[Tensor, "1 2"]]:
    """Viewmats, intrinsics, and the common size, as a tensor so that kernels are not recompiled for each size."""
    Ks = torch.stack([camera.K for camera in cameras])
    intrinsics = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], dim=1)[..., None]
    size = Ks.new_tensor([[cameras[0].width, cameras[0].height]])
    return torch.stack([camera.viewmat for camera in cameras]), intrinsics, size


def to_camera(points: Float[Tensor, "N 3"], viewmats: Float[Tensor, "B 4 4"]) -> list[Float[Tensor, "B N"]]:
    """Transform points from the world to the camera frames."""
    return [row + viewmats[:, i, 3, None] for i, row in enumerate(rotate(points.unbind(1), viewmats))]


def rotate(vectors: Sequence[Float[Tensor, "N"]], viewmats: Float[Tensor, "B 4 4"]) -> list[Float[Tensor, "B N"]]:
    """Rotate vectors, given and returned by their coordinates, from the world to the camera frames.

    Unlike a matrix product, a sum of three products fuses with the operations around it, and unlike coordinates in the
    last dimension, splats in it are vectorised.
    """
    return [dot([viewmats[:, i, j, None] for j in range(3)], vectors) for i in range(3)]


def dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Scalar product of vectors given by their coordinates."""
    return functools.reduce(torch.add, [x * y for x, y in zip(a, b, strict=True)])


def cross(a: Sequence[Tensor], b: Sequence[Tensor]) -> list[Tensor]:
    """Vector product of vectors given by their coordinates."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def halvings(opacities: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """How many times alpha has halved below its maximum at a splat's centre."""
    # Fainter splats are culled; they must not put a division by 0 into the gradients.
    return (ALPHA_MAX / opacities.clamp_min(ALPHA_MIN / 2)).log2()


def cutoffs(opacities: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Squared Mahalanobis distance within which alpha may reach 1/255; 0 for a splat too faint to count."""
    # The slack exceeds rounding errors, so that binning never loses a pixel that the kernel would count.
    return (2 * (opacities.detach() / ALPHA_MIN).log() + 1e-3).clamp_min(0)


def quats_to_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any norm."""
    return torch.stack([torch.stack(axis, dim=-1) for axis in rotated_axes(quats)], dim=-1)


def rotated_axes(quats: Float[Tensor, "N 4"]) -> list[list[Float[Tensor, "N"]]]:
    """Columns of the rotation matrices, by their coordinates."""
    w, x, y, z = quats.unbind(1)
    double = 2 / (w * w + x * x + y * y + z * z).clamp_min(1e-24)
    return [
        [1 - double * (y * y + z * z), double * (x * y + w * z), double * (x * z - w * y)],
        [double * (x * y - w * z), 1 - double * (x * x + z * z), double * (y * z + w * x)],
        [double * (x * z + w * y), double * (y * z - w * x), 1 - double * (x * x + y * y)],
    ]
