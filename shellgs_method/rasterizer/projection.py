"""3D Gaussians to screen-space Gaussians: the EWA approximation, with the conventions of gsplat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from dataparsers.camera import Camera

NEAR_PLANE = 0.01
LOW_PASS = 0.3  # variance in px² added to every splat
ALPHA_MIN = 1 / 255  # less does not count


@dataclass(frozen=True)
class Projection:
    """Gaussians on the screen.

    Attributes:
        means2d: centres in pixels.
        conics: inverse covariances (xx, xy, yy).
        covars2d: covariances (xx, xy, yy) in px².
        depths: z of the centres in the camera frame.
        cutoff: squared Mahalanobis distance up to which alpha may reach 1/255.
        visible: in front of the near plane, and the ellipse of the cut-off touches the image.
    """

    means2d: Float[Tensor, "N 2"]
    conics: Float[Tensor, "N 3"]
    covars2d: Float[Tensor, "N 3"]
    depths: Float[Tensor, "N"]
    cutoff: Float[Tensor, "N"]
    visible: Bool[Tensor, "N"]

    @property
    def reach(self) -> Float[Tensor, "N 2"]:
        """Half the width and height of the ellipse of the cut-off."""
        return (self.cutoff[:, None] * self.covars2d[:, ::2]).sqrt()


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    camera: Camera,
) -> Projection:
    """Project Gaussians (EWA splatting, Zwicker et al. 2001); differentiable in the means2d and conics."""
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    depths = z.detach()
    in_front = depths >= NEAR_PLANE
    z = torch.where(in_front, z, 1.0)  # a culled splat must not put a division by 0 into the gradients
    x, y = x / z, y / z

    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    means2d = torch.stack([fx * x + cx, fy * y + cy], dim=-1)

    # Off screen the linearised projection runs wild: its slope is held within 15 % of the image beyond the borders.
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    x = x.clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    y = y.clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    axes = rotation @ (quats_to_rotations(quats) * scales[:, None, :])  # columns: the Gaussian's half-axes
    across = (fx / z)[:, None] * (axes[:, 0] - x[:, None] * axes[:, 2])
    down = (fy / z)[:, None] * (axes[:, 1] - y[:, None] * axes[:, 2])

    xx, xy, yy = (across * across).sum(-1), (across * down).sum(-1), (down * down).sum(-1)
    # xx yy - xy², by Lagrange's identity: no cancellation for a long and thin splat
    determinant = torch.linalg.cross(across, down).square().sum(-1) + LOW_PASS * (xx + yy) + LOW_PASS**2
    conics = torch.stack([yy + LOW_PASS, -xy, xx + LOW_PASS], dim=-1) / determinant[:, None]

    covars2d = torch.stack([xx + LOW_PASS, xy, yy + LOW_PASS], dim=-1).detach()
    # The slack outweighs rounding, so that binning never loses a pixel that the kernel would count.
    cutoff = (2 * (opacities.detach() / ALPHA_MIN).log() + 1e-3).clamp_min(0)
    projection = Projection(means2d, conics, covars2d, depths, cutoff, in_front & (cutoff > 0))
    size = means2d.new_tensor([camera.width, camera.height])
    touches = (means2d + projection.reach > 0) & (means2d - projection.reach < size)
    return replace(projection, visible=projection.visible & touches.all(dim=-1))


def quats_to_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any norm."""
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
