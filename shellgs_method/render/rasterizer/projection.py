"""Project 3D Gaussians to the screen by the EWA approximation, with the conventions of gsplat."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.elementwise import Value, Vector, cross, dot, elementwise
from shellgs_method.render.rasterizer.binning import touches
from shellgs_method.render.rasterizer.renders import Ellipsoids

NEAR_PLANE = 0.01
LOW_PASS = 0.3  # variance in px² added to every splat
ALPHA_MIN = 1 / 255  # smaller alphas do not count
ALPHA_MAX = 0.999


@dataclass(frozen=True)
class Projection:
    """Splats on the screen of a camera.

    Attributes:
        means2d: centres in pixels, with a dimension for the camera, as gsplat's strategies take them.
        shapes: shape parameters of the primitive's kernels.
        depths: z of the centres in the camera frame.
        outlines: O ellipses (see :mod:`~.binning`) that together cover the pixels where alpha reaches 1/255.
        covars2d: covariances (xx, xy, yy) in px², low-pass included.
        visible: whether beyond the near plane with an outline that touches the image.
        probe: if requested, a leaf with the values of ``means2d`` on which ``probed`` alone depends.
        probed: centres, and the shape parameters that depend on them, computed from the probe.
    """

    means2d: Float[Tensor, "1 N 2"]
    shapes: Float[Tensor, "N K"]
    depths: Float[Tensor, " N"]
    outlines: Float[Tensor, "N O 7"]
    covars2d: Float[Tensor, "N 3"]
    visible: Bool[Tensor, " N"]
    probe: Float[Tensor, "1 N 2"] | None = None
    probed: Float[Tensor, "N 2+k"] | None = None


def project_gaussians(splats: Ellipsoids, camera: Camera, with_probe: bool = False) -> Projection:
    """Project Gaussians (EWA splatting, Zwicker et al. 2001); means2d and shapes are differentiable.

    The shapes are a, b, c and n of the exponent a dx² + b dx dy + c dy² + n, see :func:`halvings`; none depends on the
    screen position of the centre.
    """
    means2d, *others = elementwise(_project, *splats[:3], splats.opacities[:, None], *parameters_of(camera))
    shapes, depths, outlines, covars2d, visible = (each.squeeze(0) for each in others)
    projection = Projection(means2d, shapes, depths[:, 0], outlines[:, None], covars2d, visible[:, 0] > 0)
    if not with_probe:
        return projection
    probe = means2d.detach().requires_grad_()
    return replace(projection, probe=probe, probed=probe.squeeze(0))


def _project(
    mean: Vector, quat: Vector, scale: Vector, opacity: Vector, viewmat: Vector, intrinsics: Vector, size: Vector
) -> list[Vector]:
    """The fields of :class:`Projection`, in this order; ``visible`` is 1 or 0."""
    (fx, fy, cx, cy), (width, height), (opacity,) = intrinsics, size, opacity
    x, y, z = to_camera(mean, viewmat)
    depth = z.detach()
    in_front = depth >= NEAR_PLANE
    z = torch.where(in_front, z, 1.0)  # a culled splat must not put a division by 0 into the gradients
    x, y = x / z, y / z
    means2d = [fx * x + cx, fy * y + cy]

    # Far off screen the linearised projection diverges: clamp its slope to 15 % of the image beyond the borders.
    x = torch.minimum(torch.maximum(x, -(cx + 0.15 * width) / fx), (1.15 * width - cx) / fx)
    y = torch.minimum(torch.maximum(y, -(cy + 0.15 * height) / fy), (1.15 * height - cy) / fy)
    axes = zip(rotated_axes(quat), scale, strict=True)
    half_axes = [rotate([length * each for each in axis], viewmat) for axis, length in axes]
    across = [fx / z * (axis[0] - x * axis[2]) for axis in half_axes]
    down = [fy / z * (axis[1] - y * axis[2]) for axis in half_axes]

    xx, xy, yy = dot(across, across), dot(across, down), dot(down, down)
    # xx yy - xy², by Lagrange's identity: no cancellation for a long and thin splat
    area = cross(across, down)
    determinant = dot(area, area) + LOW_PASS * (xx + yy) + LOW_PASS**2
    xx, yy = xx + LOW_PASS, yy + LOW_PASS
    halving = math.log(2) * determinant
    shape = [0.5 * yy / halving, -xy / halving, 0.5 * xx / halving, halvings(opacity)]

    xx, xy, yy, determinant = xx.detach(), xy.detach(), yy.detach(), determinant.detach()
    cutoff = cutoffs(opacity)
    extent = cutoff * determinant
    reach = torch.sqrt(cutoff * xx), torch.sqrt(cutoff * yy)
    outline = [*(each.detach() for each in means2d), yy / extent, -xy / extent, xx / extent, *reach]
    # The ellipse of a splat too large for single precision is NaN.
    visible = in_front & (cutoff > 0) & (extent < math.inf) & touches(outline, size)
    return [means2d, shape, [depth], outline, [xx, xy, yy], [torch.where(visible, 1.0, 0.0)]]


def three_sigma(covar2d: Vector, visible: Value) -> Value:
    """Radius of a splat, a whole number, see :class:`~.renders.Renders`, from its covariance (xx, xy, yy) in px²."""
    xx, xy, yy = covar2d
    half = (xx - yy) / 2
    variance = (xx + yy) / 2 + torch.sqrt(half * half + xy * xy)
    return torch.where(visible, torch.ceil(3 * torch.sqrt(variance)), 0.0)


def parameters_of(camera: Camera) -> tuple[Float[Tensor, "1 1 16"], Float[Tensor, "1 1 4"], Float[Tensor, "2"]]:
    """Viewmat, intrinsics, and width and height of a camera, for the functions of splats here."""
    K = camera.K
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    return camera.viewmat.flatten()[None, None], intrinsics[None, None], K.new_tensor([camera.width, camera.height])


# Vectors are lists of their coordinates, and matrices of their rows' values, one row after another.


def to_camera(point: Vector, viewmat: Vector) -> list[Value]:
    """Transform a point from the world to the camera frame."""
    return [each + viewmat[4 * i + 3] for i, each in enumerate(rotate(point, viewmat))]


def rotate(vector: Vector, viewmat: Vector) -> list[Value]:
    """Rotate a vector from the world to the camera frame."""
    return [dot(viewmat[4 * i : 4 * i + 3], vector) for i in range(3)]


def halvings(opacity: Value) -> Value:
    """How many times alpha has halved below its maximum at a splat's centre."""
    # Fainter splats are culled; they must not put a division by 0 into the gradients.
    return torch.log2(ALPHA_MAX / torch.clamp_min(opacity, ALPHA_MIN / 2))


def cutoffs(opacity: Value) -> Value:
    """Squared Mahalanobis distance within which alpha may reach 1/255; 0 for a splat too faint to count."""
    # The slack exceeds rounding errors, so that binning never loses a pixel that the kernel would count.
    return torch.relu(2 * torch.log(opacity.detach() / ALPHA_MIN) + 1e-3)


def quats_to_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any norm."""
    return torch.stack([torch.stack(axis, dim=-1) for axis in rotated_axes(quats.unbind(1))], dim=-1)


def rotated_axes(quat: Vector) -> list[list[Value]]:
    """Columns of the rotation matrix of a quaternion (w, x, y, z) of any norm."""
    w, x, y, z = quat
    double = 2 / torch.clamp_min(w * w + x * x + y * y + z * z, 1e-24)
    return [
        [1 - double * (y * y + z * z), double * (x * y + w * z), double * (x * z - w * y)],
        [double * (x * y - w * z), 1 - double * (x * x + z * z), double * (y * z + w * x)],
        [double * (x * z + w * y), double * (y * z - w * x), 1 - double * (x * x + y * y)],
    ]
