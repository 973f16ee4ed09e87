"""Distortion by a lens in normalised coordinates, with derivatives: the models of COLMAP and OpenCV."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")
"""Parameters of a lens in :func:`to_pixels`. A perspective lens has k1 to p2, a fisheye lens k1, k2, k3 and k4."""
_TINY = 1e-8  # radius within which a fisheye lens does not distort


def to_pixels(
    rays: Float64[np.ndarray, "M 2"], lenses: Float64[np.ndarray, "M 10"], fisheye: bool
) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, "M 2 2"], Float64[np.ndarray, "M 2 10"]]:
    """Pixels of rays, and their derivatives by the rays and by :data:`PARAMETERS`.

    Args:
        rays: x / z and y / z in the camera's frame.
        lenses: the parameters of each ray's lens.
        fisheye: whether the lenses are OpenCV's fisheye model, else Brown's.
    """
    focal = lenses[:, :2]
    bent, by_ray, by_coefficient = (_fisheye if fisheye else _brown)(rays, lenses[:, 4:])
    by_lens = np.zeros((len(rays), 2, 10))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent.T
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = focal[:, :, None] * by_coefficient
    return focal * bent + lenses[:, 2:4], focal[:, :, None] * by_ray, by_lens


def _brown(rays: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = rays.T
    k1, k2, p1, p2 = coefficients[:, :4].T
    r2 = x**2 + y**2
    radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * (k1 + 2 * r2 * k2)  # d radial / dx = slope x
    bent = np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)], axis=1
    )
    across = x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_ray = np.stack(
        [
            radial + x**2 * slope + 2 * p1 * y + 6 * p2 * x,
            across,
            across,
            radial + y**2 * slope + 2 * p2 * x + 6 * p1 * y,
        ],
        axis=1,
    ).reshape(-1, 2, 2)
    by_coefficient = np.zeros((len(rays), 2, 6))
    by_coefficient[:, :, 0] = rays * r2[:, None]
    by_coefficient[:, :, 1] = rays * (r2**2)[:, None]
    by_coefficient[:, 0, 2] = by_coefficient[:, 1, 3] = 2 * x * y
    by_coefficient[:, 0, 3], by_coefficient[:, 1, 2] = r2 + 2 * x**2, r2 + 2 * y**2
    return bent, by_ray, by_coefficient


def _fisheye(rays: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    k = coefficients[:, [0, 1, 4, 5]]
    radius = np.maximum(np.linalg.norm(rays, axis=1), _TINY)
    angle = np.arctan(radius)
    powers = angle[:, None] ** np.array([3, 5, 7, 9])
    bent_angle = angle + (k * powers).sum(axis=1)
    slope = 1 + (k * powers * [3, 5, 7, 9]).sum(axis=1) / angle
    stretch = bent_angle / radius
    by_radius = (slope / (1 + radius**2) - stretch) / radius
    by_ray = stretch[:, None, None] * np.eye(2) + (by_radius / radius)[:, None, None] * rays[:, :, None] * rays[:, None]
    by_coefficient = np.zeros((len(rays), 2, 6))
    by_coefficient[:, :, [0, 1, 4, 5]] = rays[:, :, None] * (powers / radius[:, None])[:, None]
    return stretch[:, None] * rays, by_ray, by_coefficient
