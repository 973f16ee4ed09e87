"""A phone's video of minutes, past a long synthetic facade: of a hand that shakes, with motion blur and noise."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import av
import cv2
import numpy as np
import tyro
from jaxtyping import Float
from PIL import Image
from scipy.spatial.transform import Rotation

from shellgs_method.errors import refusals_end_the_program
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.progress import track
from shellgs_method.synthetic.appearance import developed, exposed
from shellgs_method.synthetic.scene import Facade, FacadeConfig

VIDEO, POSITIONS = "film.mp4", "positions.json"
RATE = 30
"""Frames per second. Each second shows one view."""

_MARGIN = 24  # pixels around a view, which the hand turns into the picture
_SHAKE = {1.1: 0.5, 2.7: 0.3, 6.3: 0.15}  # degrees around each axis, of Hz
_EXPOSURE = 1 / 100  # seconds
_NOISE = 4.0  # of 255


def film(
    folder: Annotated[Path, tyro.conf.Positional],
    facade: FacadeConfig = FacadeConfig(width=960, height=540, views=240, bays=16, supersampling=1),  # noqa: B008
) -> None:
    """Write FOLDER/film.mp4, a second of each view, and the true position of each frame, in metres.

    Frames of a second are turned, not moved: positions are exact.

    Args:
        folder: Output folder; views that are there are used again.
        facade: The synthetic facade.
    """
    built = Facade.build(facade)
    (folder / "views").mkdir(parents=True, exist_ok=True)
    frames = [(f"frame_{number:06d}", built.cameras[number // RATE]) for number in range(RATE * facade.views)]
    (folder / POSITIONS).write_text(json.dumps({name: camera.position.tolist() for name, camera in frames}))
    rng = np.random.default_rng(facade.seed)
    phases = rng.uniform(0, 2 * np.pi, (len(_SHAKE), 3))
    noise = rng.normal(0, _NOISE, (8, facade.height, facade.width, 3)).round().astype(np.int16)
    with av.open(str(folder / VIDEO), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "23", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = facade.width, facade.height, "yuv420p"
        for k, camera in enumerate(track(built.cameras, "Filming the synthetic facade", len(built.cameras))):
            view = _view(folder / "views" / f"{k:04d}.png", built, camera, facade.supersampling)
            for number in range(RATE * k, RATE * (k + 1)):
                opened, closed = (
                    _turned(view, camera, _shake(number / RATE + time, phases)) for time in (0, _EXPOSURE)
                )
                image = cv2.addWeighted(opened, 0.5, closed, 0.5, 0)
                image = cv2.add(image, noise[rng.integers(len(noise))], dtype=cv2.CV_8U)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _view(path: Path, facade: Facade, camera: Camera, supersampling: int) -> np.ndarray:
    """A view and its margin, rendered or read."""
    if not path.exists():
        wider = camera.K.clone()
        wider[:2, 2] += _MARGIN
        camera = Camera(camera.viewmat, wider, camera.width + 2 * _MARGIN, camera.height + 2 * _MARGIN)
        image = developed(exposed(facade.daylight, camera, supersampling), np.random.default_rng(0))
        Image.fromarray(image).save(path.with_suffix(".part"), "PNG")
        path.with_suffix(".part").replace(path)
    return np.array(Image.open(path))


def _shake(time: float, phases: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation of the camera by the hand."""
    frequencies, degrees = (np.array(list(x))[:, None] for x in (_SHAKE, _SHAKE.values()))
    angles = (degrees * np.sin(2 * np.pi * frequencies * time + phases)).sum(axis=0)
    return Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()


def _turned(view: np.ndarray, camera: Camera, rotation: Float[np.ndarray, "3 3"]) -> np.ndarray:
    """The picture of the camera turned by a rotation, cut out of its view."""
    K = camera.K.numpy().copy()
    K[:2, 2] -= 0.5  # OpenCV counts from the first pixel's centre
    wider = K.copy()
    wider[:2, 2] += _MARGIN
    homography = wider @ rotation @ np.linalg.inv(K)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(
        view, homography, (camera.width, camera.height), flags=flags, borderMode=cv2.BORDER_REFLECT
    )


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(film)
