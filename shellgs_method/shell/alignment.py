"""The similarity from the shell's frame to the scene's, and its file."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash, read_json, remove_leftovers, write_whole
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.clouds import Cloud
from shellgs_method.files.photographs import View
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.geometry.axes import upwards
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine, scale_of, transformed
from shellgs_method.shell.clouds import Mesher
from shellgs_method.shell.loading import load_shell
from shellgs_method.shell.mesh import ShellMesh

_TAIL = 3  # last parts of a path, by which a file is looked for in a project that was moved


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity from the shell's frame to the scene's, and how it was found.

    Attributes:
        shell_to_scene: uniform scale, rotation and translation.
        shells: the shell's files, which share one frame, relative to the scene's folder (or absolute).
        metres_per_shell_unit: 1 for a shell in metres, 0.001 for one in millimetres.
        source: how the alignment was found, for people.
        verdict: verdict of the validation, "good" or "doubtful"; empty if not validated.
        metrics: main metrics behind the verdict.
        mesher: method that meshes a point cloud.
        cameras: cameras it was found for, in whose frame alone it is valid; none in files of older versions.
        model: COLMAP model of these, relative to the scene's folder, if they were adjusted to the shell; else empty.
        spacing: size in metres of the voxels in which a point cloud is merged; None for what the cameras resolve.
        up: the shell's direction upwards, a unit vector; if None, it is found from the cameras, where they determine
        it.
        crs: coordinate reference system of the shell, a code such as EPSG:25832 or WKT; empty if unknown.
        hashes: sha256 of the shell's files that it was found for; none in files of older versions.

    Raises:
        SceneError: the matrix is not a similarity, or mirrors, the mesher is unknown, or the spacing is not positive.
    """

    shell_to_scene: Float64[np.ndarray, "4 4"]
    shells: tuple[str, ...]
    metres_per_shell_unit: float = 1.0
    source: str = "matrix"
    verdict: str = ""
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    mesher: Mesher = "planes"
    cameras: BoundCameras = field(default_factory=BoundCameras)
    model: str = ""
    spacing: float | None = None
    up: Float64[np.ndarray, " 3"] | None = None
    crs: str = ""
    hashes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the matrix, the unit and the mesher."""
        matrix = np.array(self.shell_to_scene, dtype=np.float64)
        matrix.setflags(write=False)
        object.__setattr__(self, "shell_to_scene", matrix)
        _check_similarity(matrix)
        if not 0 < self.metres_per_shell_unit < np.inf:
            raise SceneError(f"the shell's unit cannot be {self.metres_per_shell_unit} metres long")
        object.__setattr__(self, "up", self._upwards() if self.up is None else _direction(self.up))
        if not self.shells:
            raise SceneError("the alignment names no file of the shell")
        if self.hashes and len(self.hashes) != len(self.shells):
            raise SceneError(
                f"the alignment has {len(self.hashes)} hashes of {len(self.shells)} files: align the shell again"
            )
        if self.mesher not in get_args(Mesher):
            raise SceneError(f"unknown mesher {self.mesher!r}: it must be one of {', '.join(get_args(Mesher))}")
        if self.spacing is not None and not 0 < self.spacing < np.inf:
            raise SceneError(f"points cannot be merged in voxels of {self.spacing:g} m: give a --spacing above 0")

    def __eq__(self, other: object) -> bool:
        """Compare all fields."""
        return isinstance(other, Alignment) and self._fields() == other._fields()

    @property
    def named(self) -> str:
        """The shell's files, for people: relative to the scene, or by their names where they are elsewhere."""
        return ", ".join(path.name if path.is_absolute() else str(path) for path in map(Path, self.shells))

    def files(self, scene: Path) -> list[Path]:
        """The shell's files, also where they were moved together with the scene."""
        return [_file(scene, shell, known) for shell, known in zip_longest(self.shells, self.hashes)]

    @property
    def scale(self) -> float:
        """Scene units in one shell unit."""
        return scale_of(self.shell_to_scene)

    @property
    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """The rotation from the shell's axes to the scene's, exactly orthonormal."""
        u, _, vt = np.linalg.svd(self.shell_to_scene[:3, :3])
        return u @ vt

    def _upwards(self) -> Float64[np.ndarray, " 3"] | None:
        """Up in the shell's frame by the cameras; exactly an axis of it if they agree with that."""
        up = upwards(self.cameras.cameras.values(), [sign * axis for axis in self.rotation.T for sign in (1, -1)])
        return None if up is None else _direction(self.rotation.T @ up)

    def bound(self, scene: Path, views: Sequence[View]) -> Alignment:
        """The alignment bound to the shell's present files and to the cameras of views, which determine what is up.

        Raises:
            FileNotFoundError: a file is missing.
        """
        hashes = tuple(map(content_hash, self.files(scene)))
        return replace(self, hashes=hashes, cameras=BoundCameras.of(views), up=None)

    @property
    def metres_per_unit(self) -> float:
        """Metres in one scene unit."""
        return self.metres_per_shell_unit / self.scale

    @property
    def error(self) -> float | None:
        """Error of the alignment as a whole, in metres; None if it was not validated.

        It is the largest of the magnitude of the SfM points' median signed distance, the motion of a fit to them, and
        what coordinates are rounded by.
        """
        names = ("bias_m", "pull_m", "rounding_m")
        known = [abs(metric) for name in names if (metric := self.metrics.get(name)) is not None]
        return max(known, default=None)

    def places_like(self, other: Alignment) -> bool:
        """Whether both place the same surface identically, however they were found."""
        return (
            np.array_equal(self.shell_to_scene, other.shell_to_scene)
            and self.shells == other.shells
            and self.metres_per_shell_unit == other.metres_per_shell_unit
            and self.mesher == other.mesher
            and self.spacing == other.spacing
            and (self.hashes == other.hashes or not (self.hashes and other.hashes))
        )

    def changed_file(self, scene: Path) -> Path | None:
        """The first of the shell's files that is not as it was when it was aligned, if there is one."""
        hashes = dict(zip(self.files(scene), self.hashes, strict=False))
        return next((path for path, known in hashes.items() if path.is_file() and content_hash(path) != known), None)

    def check(self, scene: Path, views: Sequence[View]) -> None:
        """Refuse a shell that has changed, and photographs whose cameras are not those that it was aligned to.

        Raises:
            SceneError: a file has changed, or the cameras are others.
        """
        if path := self.changed_file(scene):
            raise SceneError(
                f"{path} has changed since it was aligned: run `shellgs align {shlex.quote(str(scene))}` to validate "
                "it as it is now, or align it again"
            )
        if changed := self.cameras.changed(views):
            raise SceneError(
                f"the alignment of {self.named} was found for other cameras than those of {scene}: {changed}; run "
                f"`shellgs align {shlex.quote(str(scene))}` to validate it with these, or align the shell to them again"
            )

    def meshed_by(self, mesher: Mesher | None, spacing: float | None = None) -> Alignment:
        """Return the same alignment with another mesher or spacing, without a verdict; None keeps either."""
        mesher, spacing = mesher or self.mesher, self.spacing if spacing is None else spacing
        if (mesher, spacing) == (self.mesher, self.spacing):
            return self
        return replace(self, mesher=mesher, spacing=spacing, verdict="", metrics={})

    def load_shell(self, scene: Path, views: Sequence[View], surfaces: Sequence[Geometry | Cloud] = ()) -> ShellMesh:
        """Load the shell's mesh, in its own frame; the mesh of a point cloud is cached in ``scene/shell``.

        Args:
            scene: the scene's folder.
            views: photographs of the shell, whose cameras say where and how finely a point cloud is meshed.
            surfaces: what the shell's files hold, if they were read already.

        Raises:
            FileNotFoundError: the shell is missing.
            SceneError: the shell cannot be used, or its coordinates were rounded by decimetres.
        """
        return load_shell(
            *self.files(scene),
            surfaces=surfaces,
            cache=scene / "shell",
            cameras=[self._in_shell(view.camera) for view in views],
            mesher=self.mesher,
            spacing=self.spacing,
            metres_per_unit=self.metres_per_shell_unit,
        )

    def _in_shell(self, camera: Camera) -> Camera:
        """A camera of the scene in the shell's frame and unit."""
        viewmat = camera.viewmat.detach().cpu().double().numpy() @ self.shell_to_scene
        viewmat[:3] /= self.scale
        return replace(camera, viewmat=torch.from_numpy(viewmat), K=camera.K.detach().cpu().double())

    def apply(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Transform points of the shell to the scene's frame, in double precision."""
        return transformed(np.asarray(points, dtype=np.float64), self.shell_to_scene)

    def save(self, path: Path) -> None:
        """Write the alignment as json."""
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        lines = (f"{json.dumps(name)}: {json.dumps(v, ensure_ascii=False)}" for name, v in self._fields().items())
        write_whole(path, "{\n " + ",\n ".join(lines) + "\n}\n")

    def record(self, path: Path, views: Sequence[View]) -> None:
        """Write a file of the alignment, bound to the cameras of views; one that says the same keeps its verdict."""
        known, bound = Alignment.load(path) if path.is_file() else None, self.bound(path.parents[1], views)
        same = known is not None and not known.cameras.changed(views)
        if known is None or not same or not known.places_like(bound):
            replace(bound, model=known.model if known and same else self.model).save(path)

    @classmethod
    def load(cls, path: Path) -> Alignment:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: the file does not exist.
            SceneError: the file is damaged or its matrix is not a similarity.
        """
        if not path.is_file():
            scene = shlex.quote(str(path.parent.parent))
            raise FileNotFoundError(f"{path} does not exist: align the shell with `shellgs align {scene} SHELL …`")
        try:
            fields = read_json(path)
            matrix, shells = np.array(fields["shell_to_scene"], dtype=np.float64), _strings(fields["shell"])
            return cls(matrix, shells, **{name: read(fields[name]) for name, read in _READ.items() if name in fields})
        except KeyError as error:
            raise SceneError(f"{path}: the entry {error} is missing") from error
        except SceneError as error:
            raise SceneError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise SceneError(f"{path} is damaged ({error}): align the shell again") from error

    @classmethod
    def from_matrix_file(
        cls,
        path: Path,
        shells: tuple[str, ...],
        metres_per_shell_unit: float = 1.0,
        global_shift: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> Alignment:
        """Read a row-major 4x4 matrix from a file: text as CloudCompare, NumPy and Blender print it, json or npy.

        Args:
            path: the file.
            shells: the shell's files, relative to the scene's folder (or absolute).
            metres_per_shell_unit: 1 for a shell in metres.
            global_shift: CloudCompare's "global shift", which it adds to a cloud's coordinates on loading, so that its
                matrices apply to the shifted coordinates.

        Raises:
            FileNotFoundError: the file does not exist.
            SceneError: the file does not hold a 4x4 matrix, or one that is not a similarity.
        """
        if not path.is_file():
            raise FileNotFoundError(f"the matrix file {path} does not exist")
        shift = affine(np.eye(3), global_shift)
        try:
            return cls(_read_matrix(path) @ shift, shells, metres_per_shell_unit, source=f"matrix file {path.name}")
        except ValueError as error:
            raise SceneError(f"{path}: {error}") from error

    def _fields(self) -> dict:
        fields = dict(vars(self))
        matrix, shells = fields.pop("shell_to_scene"), fields.pop("shells")
        return {
            "shell_to_scene": matrix.tolist(),
            "shell": shells[0] if len(shells) == 1 else list(shells),  # one as in older versions
            **fields,
            "up": None if self.up is None else self.up.tolist(),
            "metrics": dict(self.metrics),
            "cameras": self.cameras.to_json(),
        }


def _file(scene: Path, shell: str, known: str | None) -> Path:
    """A file of a shell; if one outside the scene is gone, that of the same contents in a folder above the scene."""
    path = scene / shell
    if not known or not Path(shell).is_absolute() or os.path.exists(path):
        return path
    names = [Path(*path.parts[1:][-parts:]) for parts in range(1, _TAIL + 1)]
    candidates = (above / name for above in scene.resolve().parents for name in names)
    return next((found for found in candidates if os.path.isfile(found) and content_hash(found) == known), path)


def _strings(value: str | Sequence[object]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(map(str, value))


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


_READ: dict[str, Callable[[Any], Any]] = {
    "metres_per_shell_unit": float,
    "source": str,
    "verdict": str,
    "metrics": lambda metrics: {str(name): _number(value) for name, value in dict(metrics).items()},
    "mesher": lambda mesher: mesher,
    "cameras": BoundCameras.from_json,
    "model": str,
    "spacing": _number,
    "up": lambda up: None if up is None else np.array(up, dtype=np.float64),
    "crs": str,
    "hashes": lambda hashes: tuple(map(str.lower, _strings(hashes))),
}
"""What files may say besides the matrix and the shell, which older ones do not say all of."""

_AROUND_NUMBERS = re.compile(
    r"\[\d+:\d+:\d+\]|#.*|<Matrix 4x4|dtype=[\w.]+|[A-Za-z_][\w.]*(?= *[=:(\[])|^ *-(?= )|[\[\](),;:=>]", re.MULTILINE
)
"""What programs write beside the numbers of a matrix: times in CloudCompare's console, comments, names, brackets."""


def _read_matrix(path: Path) -> Float64[np.ndarray, "4 4"]:
    try:
        if path.suffix == ".npy":
            matrix = np.load(path, allow_pickle=False, mmap_mode="r")  # a false size in the header allocates nothing
        elif path.suffix == ".json":
            matrix = json.loads(path.read_bytes())
        else:
            matrix = _AROUND_NUMBERS.sub(" ", path.read_text("utf-8-sig")).split()
        matrix = np.array(matrix, dtype=np.float64)
    except Exception as error:  # each format's reader raises errors of its own for a damaged file
        raise SceneError(f"this is not a 4x4 matrix ({' '.join(str(error).split())})") from error
    if matrix.shape not in ((4, 4), (16,)):
        decimal = ": are its commas decimal?" if matrix.shape == (32,) else ""
        raise SceneError(f"this is not a 4x4 matrix but {' x '.join(map(str, matrix.shape))} numbers{decimal}")
    return matrix.reshape(4, 4)


def _direction(vector: np.ndarray) -> Float64[np.ndarray, " 3"]:
    """A unit vector, exactly an axis where it is one but for rounding."""
    vector = np.asarray(vector, dtype=np.float64)
    length = np.linalg.norm(vector) if vector.shape == (3,) else np.nan
    if not 0 < length < np.inf:
        raise SceneError("the alignment's up is not a direction of three numbers, such as [0, 0, 1]")
    unit = vector if abs(length - 1) < 1e-12 else vector / length  # again and again, it would change by rounding
    nearest = np.round(unit)
    return nearest if np.abs(unit - nearest).max() < 1e-9 else unit


def _check_similarity(matrix: np.ndarray) -> None:
    if matrix.shape != (4, 4):
        raise SceneError(f"the alignment must be a 4x4 matrix, not {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise SceneError("the alignment's matrix holds NaN or infinite values")
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        row = " ".join(f"{value:g}" for value in matrix[3])
        raise SceneError(f"the alignment's last row is {row} instead of 0 0 0 1: is the matrix column-major?")
    scales = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if scales[2] <= 1e-12 * scales[0]:
        raise SceneError("the alignment's matrix is singular: it flattens the shell")
    if scales[0] - scales[2] > 1e-3 * scales[0]:
        raise SceneError(
            f"the alignment scales by {scales[0]:.6g} in one direction and by {scales[2]:.6g} in another: only a "
            "rotation, a translation and one uniform scale are allowed"
        )
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise SceneError("the alignment mirrors the shell (negative determinant): one axis has the wrong sign")
