"""What only one photograph shows, such as passers-by and cars: found while a run learns what the others show there."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, interpolate, max_pool2d

from shellgs_method.geometry.camera import Camera

GRID = 64
"""Cells along either side of a photograph, whose mean colours are compared, smoothed over 3 x 3 of them."""
NEIGHBOURS = 16
"""Nearest photographs that one is compared with."""
FACTOR, FLOOR = 2.0, 0.05
"""A cell's residual is an outlier above FACTOR · (FLOOR + the others' residual), of colours in [0, 1]."""
HIDDEN = 1.1
"""Depth of a point, relative to what is rendered of another view there, above which it is hidden from it."""


class Transients(nn.Module):
    """Colours and rendered depths of V photographs, by which one is compared with others at the rendered surface.

    RobustNeRF (Sabour et al. 2023) leaves out a photograph's largest residuals, smoothed over its pixels, and with them
    what is not learned yet. Here the render of a view is compared with the other photographs as well: where only this
    photograph shows something else, they agree with the render; where the render is wrong, they differ from it as much.
    Nothing is left out where fewer than two others see the surface.
    """

    colours: Float[Tensor, "V G G 3"]
    depths: Float[Tensor, "V G G"]
    viewmats: Float[Tensor, "V 4 4"]
    Ks: Float[Tensor, "V 3 3"]

    def __init__(self, num_views: int):
        super().__init__()
        # Not in checkpoints: a resumed run knows them after one pass over its photographs.
        self.register_buffer("colours", torch.full((num_views, GRID, GRID, 3), torch.nan), persistent=False)
        self.register_buffer("depths", torch.zeros(num_views, GRID, GRID), persistent=False)
        self.register_buffer("viewmats", torch.eye(4).repeat(num_views, 1, 1), persistent=False)
        self.register_buffer("Ks", torch.eye(3).repeat(num_views, 1, 1), persistent=False)

    @torch.no_grad()
    def forward(
        self,
        index: int,
        photograph: Float[Tensor, "H W 3"],
        rgb: Float[Tensor, "H W 3"],
        depth: Float[Tensor, "H W 1"],
        camera: Camera,
    ) -> Bool[Tensor, "H W 1"]:
        """Find what only one photograph shows, by its render and by the others as they were rendered last.

        Args:
            index: index of the photograph.
            photograph: at the mean exposure.
            rgb: its render at the mean exposure.
            depth: rendered z-depth in units of the world.
            camera: camera of the photograph.
        """
        at_cells = camera.resized(GRID, GRID)
        self.colours[index], rendered = _cells(photograph), _cells(rgb)
        self.depths[index] = interpolate(depth.permute(2, 0, 1)[None], (GRID, GRID), mode="nearest-exact")[0, 0]
        self.viewmats[index], self.Ks[index] = at_cells.viewmat, at_cells.K
        residual = (self.colours[index] - rendered).abs().mean(dim=-1)
        outliers = residual > FACTOR * (FLOOR + self._elsewhere(index, rendered, at_cells))  # false for NaN
        margin = max_pool2d(outliers.float()[None], 3, 1, 1)
        return interpolate(margin[None], rgb.shape[:2], mode="nearest")[0, 0, ..., None] > 0

    def _elsewhere(self, index: int, rendered: Float[Tensor, "G G 3"], camera: Camera) -> Float[Tensor, "G G"]:
        """Median residual of the others against the render of one view; NaN where fewer than two see its surface."""
        rotations, offsets = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        positions = -(rotations.mT @ offsets[..., None])[..., 0]
        far = (positions - positions[index]).norm(dim=-1).where(self.colours[:, 0, 0, 0].isfinite(), torch.inf)
        far[index] = torch.inf
        near = far.topk(min(NEIGHBOURS, len(far)), largest=False).indices
        points = (self.depths[index][..., None] * camera.rays().to(offsets) - offsets[index]) @ rotations[index]
        in_cameras = torch.einsum("vij,rcj->vrci", rotations[near], points) + offsets[near, None, None]
        z = in_cameras[..., 2]
        pixels = torch.einsum("vij,vrcj->vrci", self.Ks[near], in_cameras)[..., :2] / z.clamp_min(1e-9)[..., None]
        inside = (z > 0) & ((pixels >= 0) & (pixels < GRID)).all(dim=-1) & far[near].isfinite()[:, None, None]
        columns, rows = pixels.where(inside[..., None], 0.0).long().unbind(dim=-1)
        view = near[:, None, None].expand_as(rows)
        seen = inside & (z < HIDDEN * self.depths[view, rows, columns])
        residuals = (self.colours[view, rows, columns] - rendered).abs().mean(dim=-1).where(seen, torch.nan)
        return residuals.nanmedian(dim=0).values.where(seen.sum(dim=0) >= 2, torch.nan)


def _cells(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "G G 3"]:
    cells = adaptive_avg_pool2d(image.permute(2, 0, 1), GRID)
    return avg_pool2d(cells, 3, 1, 1, count_include_pad=False).permute(1, 2, 0)
