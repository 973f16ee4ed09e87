"""Extract the sharpest frame of each segment of a video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import av
import av.container
import av.error
import numpy as np
from av.stream import Disposition
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8
from PIL import Image
from rich.progress import Progress
from scipy.ndimage import laplace, median_filter

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.transfer import HDR, Transfer, tone_mapped

FRAMES_PER_SECOND = 5
"""Maximum rate. At walking pace this is a frame every 25 cm: closer ones add work and no parallax."""

_PICTURES = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
_NEIGHBOURHOOD = 31  # frames, about a second, in which the subject hardly changes


def extract_frames(video: Path, folder: Path, count: int, progress: Progress) -> None:
    """Write the sharpest frame of each of at most ``count`` equal segments of a video, upright, as JPEG.

    Files are numbered by their frames in the video. Of several videos in a file, the largest is used, and told.

    Raises:
        SceneError: the file cannot be read as a video, or holds no frame.
    """
    with _opened(video) as (container, stream):
        transfer = _hdr(video, stream)
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
    with _opened(video) as (container, stream):
        for number, frame in enumerate(container.decode(stream)):
            if number in chosen:
                image = _upright(frame, transfer)
                image.save(folder / f"frame_{number:06d}.jpg", quality=95, subsampling=0)
                progress.advance(task)


def first_frame(video: Path) -> av.VideoFrame | None:
    """The first frame of a video, if it has one."""
    with _opened(video) as (container, stream):
        return next(container.decode(stream), None)


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
def _opened(video: Path) -> Iterator[tuple[av.container.InputContainer, VideoStream]]:
    try:
        with av.open(str(video)) as container:
            stream = _main_stream(video, container.streams.video)
            stream.thread_type = "AUTO"
            yield container, stream
    except av.error.FFmpegError as error:
        raise SceneError(
            f"{video} cannot be read as a video ({error.strerror}): copy it again if it is cut off or damaged, or "
            "convert it to mp4"
        ) from error


def _main_stream(video: Path, streams: Sequence[VideoStream]) -> VideoStream:
    """The largest stream that is a video, not a cover, which files may begin with, nor a proxy."""
    moving = [stream for stream in streams if not stream.disposition & _PICTURES and stream.frames != 1]
    if not moving:
        what = f", but {len(streams)} pictures" if streams else ""
        raise SceneError(f"{video} holds no video{what}")
    largest = max(moving, key=lambda stream: stream.width * stream.height)  # the first of equals
    if len(moving) > 1:
        sizes = ", ".join(f"{stream.width}x{stream.height}" for stream in moving)
        notice(
            f"{video} holds {len(moving)} videos of {sizes} pixels: {largest.width}x{largest.height} is used, the "
            f"stream {largest.index}."
        )
    return largest


def _hdr(video: Path, stream: VideoStream) -> Transfer | None:
    transfer = HDR.get(stream.codec_context.color_trc)
    if transfer:
        notice(
            f"{video} is HDR ({transfer}), and its frames are tone-mapped to the colours of a photograph: bright walls "
            "lose contrast; record or export it as SDR if you can."
        )
    return transfer


def _upright(frame: av.VideoFrame, transfer: Transfer | None) -> Image.Image:
    if transfer is None:
        image = frame.to_image()
    else:
        image = Image.fromarray(tone_mapped(frame.to_ndarray(format="rgb48le"), transfer))
    return image.rotate(frame.rotation, expand=True)
