"""Metrics of the visible surface as a point cloud: accuracy, completeness, Chamfer distance, F-score."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.voxels import voxel_means


@dataclass(frozen=True)
class SurfaceComparison:
    """Nearest-neighbour distances between a reconstructed point cloud and a reference, in both directions.

    The F-score is that of Tanks and Temples (Knapitsch et al. 2017), the Chamfer distance the paper's: the mean of
    accuracy and completeness, not squared. Mean distances require points in both clouds.
    """

    to_reference: Float[ndarray, " N"]
    """Distance of each reconstructed point."""
    to_reconstruction: Float[ndarray, " M"]
    """Distance of each reference point."""

    @property
    def accuracy(self) -> float:
        """Mean distance of the reconstruction from the reference."""
        return float(self.to_reference.mean())

    @property
    def completeness(self) -> float:
        """Mean distance of the reference from the reconstruction."""
        return float(self.to_reconstruction.mean())

    @property
    def chamfer(self) -> float:
        """Mean of accuracy and completeness."""
        return (self.accuracy + self.completeness) / 2

    def precision(self, threshold: float) -> float:
        """Share of the reconstruction closer than ``threshold`` to the reference."""
        return float((self.to_reference < threshold).mean()) if len(self.to_reference) else 0.0

    def recall(self, threshold: float) -> float:
        """Share of the reference closer than ``threshold`` to the reconstruction."""
        return float((self.to_reconstruction < threshold).mean()) if len(self.to_reconstruction) else 0.0

    def f_score(self, threshold: float) -> float:
        """Harmonic mean of precision and recall; zero if both are zero."""
        precision, recall = self.precision(threshold), self.recall(threshold)
        return 2 * precision * recall / max(precision + recall, 1e-12)


def compare_surfaces(
    points: Float[ndarray, "N 3"], reference: Float[ndarray, "M 3"], voxel: float
) -> SurfaceComparison:
    """Compare two point clouds after thinning both to one point per voxel.

    Sample density alone can change the Chamfer distance by a factor of three: compare metrics only at the same voxel
    size, and state it.
    """
    points, reference = voxel_means(points, voxel), voxel_means(reference, voxel)
    return SurfaceComparison(_nearest(points, reference), _nearest(reference, points))


def back_project(depth: Float[Tensor, "H W 1"], camera: Camera, mask: Bool[Tensor, "H W 1"]) -> Float[ndarray, "N 3"]:
    """Back-project the masked pixels to points in the camera frame, in float64."""
    return (depth.double() * camera.rays().to(depth.device).double())[mask[..., 0]].cpu().numpy()


def _nearest(points: Float[ndarray, "N 3"], others: Float[ndarray, "M 3"]) -> Float[ndarray, " N"]:
    """Distance of each point to the nearest of the others, infinite if there are none."""
    return point_tree(others).query(points, workers=-1)[0]
