"""Geo-tags of photographs, by a phone or drone: metres off, enough to keep the search for the shell to where it was.

Their heights are above the ellipsoid, the sea or the start, by the maker, and are not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import ExifTags, Image

from shellgs_method.files.crs import conversion
from shellgs_method.files.exif import exif_of
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import transformed

REACH = 10.0
"""Median distance in metres of cameras from their geo-tags, beyond which an alignment is a wrong one; between
buildings, signals are reflected."""
LEAST = 3
"""Geo-tags by which the search is kept to where they are."""
_WALK = 50.0  # metres, within which photographs of a building were taken that have the same geo-tag
_SPOT = 1.0  # metres, within which tags are on one spot
_SHARED = 0.25  # of the cameras' spread, up to which those with the same tag may be apart
_SIGNS = {"N": 1, "E": 1, "S": -1, "W": -1}


@dataclass(frozen=True)
class GeoTags:
    """Where photographs say that they were taken, in the shell's frame.

    Attributes:
        cameras: positions of their cameras in the scene's frame.
        places: their easting and northing, in a frame of the shell in metres whose z is up.
    """

    cameras: Float64[np.ndarray, "N 3"]
    places: Float64[np.ndarray, "N 2"]

    @staticmethod
    def of(views: Sequence[View], crs: str, survey_from_shell: Float64[np.ndarray, "4 4"]) -> GeoTags | None:
        """Those of the photographs, if three or more have one that can be converted to the shell's system.

        Args:
            views: the photographs.
            crs: coordinate reference system of the shell.
            survey_from_shell: motion and unit of the shell's frame in metres, which keeps the vertical.
        """
        from pyproj import CRS

        tagged = _tagged(views)
        if not tagged:
            return None
        degrees = np.array([place for _, place in tagged], dtype=np.float64)
        ground = conversion(CRS.from_epsg(4326), CRS.from_user_input(crs))(degrees)
        known = np.isfinite(ground).all(axis=1)
        if known.sum() < LEAST:
            return None
        cameras = positions(view.camera for view, _ in tagged)[known]
        shell = np.pad(ground[known], ((0, 0), (0, 1)))
        return GeoTags(cameras, transformed(shell, survey_from_shell)[:, :2])

    def scales(self, up: Float64[np.ndarray, " 3"]) -> tuple[float, float]:
        """Least and greatest scale, in metres per unit of the scene, by how far apart the photographs were taken.

        Args:
            up: up direction of the scene.
        """
        level = self.cameras - np.outer(self.cameras @ up, up) / (up @ up)
        there, here = _spread(self.places), _spread(level)
        reach = _WALK if self.repeated else REACH
        return max(there - reach, 0.0) / max(here, 1e-12), (there + reach) / max(here, 1e-12)

    @property
    def repeated(self) -> bool:
        """Whether tags of photographs far apart are the same, or all are on about one spot: then they tell no scale.

        Without a signal, phones repeat the last place they knew; the cameras of a rig, and frames of a second, share
        theirs rightly.
        """
        _, tag, count = np.unique(self.places, axis=0, return_inverse=True, return_counts=True)
        total = np.zeros((len(count), 3))
        np.add.at(total, tag.ravel(), self.cameras)
        within = np.linalg.norm(self.cameras - (total / count[:, None])[tag.ravel()], axis=1)
        return bool(np.median(within) > _SHARED * _spread(self.cameras) or _spread(self.places) < _SPOT)

    @property
    def fresh(self) -> GeoTags:
        """The first photograph of each place: later ones may have been taken after the signal was lost."""
        first = np.sort(np.unique(self.places, axis=0, return_index=True)[1])
        return self if self.repeated else GeoTags(self.cameras[first], self.places[first])

    def shift(self, similarity: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 2"]:
        """The shift, in metres to the east and north, that takes cameras to their geo-tags in the median.

        Args:
            similarity: rotation from the scene to the shell's frame, times the scale.
        """
        return np.median(self.places - (self.cameras @ similarity.T)[:, :2], axis=0)

    def apart(self, survey_from_scene: Float64[np.ndarray, "4 4"]) -> float:
        """Median distance, on the ground, of cameras from their geo-tags under an alignment, in metres."""
        placed = transformed(self.cameras, survey_from_scene)[:, :2]
        return float(np.median(np.linalg.norm(placed - self.places, axis=1)))


def _spread(places: Float64[np.ndarray, "N D"]) -> float:
    """Median distance from the middle."""
    return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def count_geo_tags(views: Sequence[View]) -> int:
    """Number of photographs that have one."""
    return len(_tagged(views))


def _tagged(views: Sequence[View]) -> list[tuple[View, tuple[float, float]]]:
    """Photographs that have a geo-tag, with their longitude and latitude."""
    return [(view, place) for view in views if (place := _geo_tag(view.image))]


def _geo_tag(path: Path) -> tuple[float, float] | None:
    """Longitude and latitude in degrees, by WGS 84; None where there is none, or it is damaged, or 0 0 of no signal."""
    try:
        with Image.open(path) as image:
            gps = exif_of(image).get_ifd(ExifTags.IFD.GPSInfo)
        lon, lat = (
            float(np.dot([float(part) for part in gps[tag]], [1, 1 / 60, 1 / 3600]))
            * _SIGNS[str(gps[ref]).strip().upper()[:1]]
            for tag, ref in (
                (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef),
                (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef),
            )
        )
    except (OSError, KeyError, ValueError, TypeError, ZeroDivisionError):
        return None
    return (lon, lat) if (lon or lat) and abs(lon) <= 180 and abs(lat) <= 90 else None
