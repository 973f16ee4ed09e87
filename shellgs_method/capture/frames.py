"""Extract the sharpest frame of each segment of a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import av.container
import av.error
import numpy as np
from jaxtyping import Float, UInt8
from rich.progress import Progress
from scipy.ndimage import laplace, median_filter

from dataparsers.errors import SceneError

FRAMES_PER_SECOND = 5
"""Maximum rate. At walking pace this is a frame every 25 cm: closer ones add work and no parallax."""

_NEIGHBOURHOOD = 31  # frames, about a second, in which the subject hardly changes


def extract_frames(video: Path, folder: Path, count: int, progress: Progress) -> None:
    """Write the sharpest frame of each of at most ``count`` equal segments of a video, upright, as JPEG.

    Files are numbered by their frames in the video.

    Raises:
        SceneError: the file cannot be read as a video, or holds no frame.
    """
    with _opened(video) as container:
        stream = container.streams.video[0]
        task = progress.add_task("looking for sharp frames", total=stream.frames or None)
        sharpnesses, times = [], []
        for frame in container.decode(stream):
            half = frame.reformat(frame.width // 2, frame.height // 2, format="gray")
            sharpnesses.append(sharpness(half.to_ndarray()))
            times.append(frame.time if frame.time is not None else len(times) / float(stream.average_rate or 30))
            progress.update(task, completed=len(times))
        if not times:
            raise SceneError(f"{video} holds no frames: is it a complete video?")
    chosen = sharpest(np.array(sharpnesses), np.array(times), count)
    task = progress.add_task("keeping the sharpest", total=len(chosen))
    with _opened(video) as container:
        for number, frame in enumerate(container.decode(video=0)):
            if number in chosen:
                image = frame.to_image().rotate(frame.rotation, expand=True)
                image.save(folder / f"frame_{number:06d}.jpg", quality=95, subsampling=0)
                progress.advance(task)


def sharpness(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Variance of the Laplacian."""
    return float(laplace(grey.astype(np.float32)).var())


def sharpest(sharpnesses: Float[np.ndarray, " N"], times: Float[np.ndarray, " N"], count: int) -> set[int]:
    """Indices of the sharpest frame in each of at most ``count`` equal segments of time.

    Sharpness is relative to the median of neighbouring frames, or a blurred textured wall would beat a sharp plain one.
    """
    relative = sharpnesses / np.maximum(median_filter(sharpnesses, _NEIGHBOURHOOD), 1e-6)
    since = times - times.min()
    count = max(1, min(count, round(FRAMES_PER_SECOND * since.max())))
    # The small offset keeps rounding from moving a frame on a border into the segment before.
    segment = np.minimum(since / max(since.max(), 1e-6) * count + 1e-6, count - 1).astype(int)
    members = (np.flatnonzero(segment == k) for k in range(count))
    return {int(m[relative[m].argmax()]) for m in members if len(m)}


@contextmanager
def _opened(video: Path) -> Iterator[av.container.InputContainer]:
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise SceneError(f"{video} holds no video")
            container.streams.video[0].thread_type = "AUTO"
            yield container
    except av.error.FFmpegError as error:
        raise SceneError(
            f"{video} cannot be read as a video ({error.strerror}): copy it again if it is cut off or damaged, or "
            "convert it to mp4"
        ) from error
