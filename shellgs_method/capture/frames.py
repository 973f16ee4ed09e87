"""Extract the sharpest frame of each stretch of a video, in which the picture moves by as much as in the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import av.container
import av.error
import cv2
import numpy as np
from av.stream import Disposition
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8
from PIL import Image
from rich.progress import Progress
from scipy.ndimage import median_filter, uniform_filter1d

from shellgs_method.capture.sources import show_the_same
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.transfer import HDR, Transfer, narrowed, tone_mapped

FRAMES_PER_SECOND = 5
"""Maximum rate. At walking pace this is a frame every 25 cm: closer ones add work and no parallax."""
STEP = 0.05
"""Motion of the picture from one frame to the next, in widths: ten frames on, half of the picture is still in view."""
PANORAMAS_PER_SECOND = 2
"""Rate of 360° videos: at walking pace 70 cm, as they see far to the sides."""

_PICTURES = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
_NEIGHBOURHOOD = 31  # frames, about a second, in which the subject hardly changes
_SMALL = 128  # pixels, the width at which motion is measured
_PACE = 0.2  # seconds between the frames that motion is measured between: pixels, not fractions of one
_UNTAGGED = 2  # a colour space that is not said (H.273)
_SQUARE = 0.01  # by which a pixel's sides may differ: programs round them
_PAUSE = 10.0  # seconds between two frames that are no step, but a break, as where files were joined
_TIMED = ("mov", "avi")  # formats that say how long a stream is
_WHOLE = 0.9  # of that time, is as good as all
_BLACK = 32  # levels that compressed black reaches
_BY_TIME = 0.2  # share of the frames that are spread over time: motion towards the building moves no picture aside


def extract_frames(video: Path, folder: Path, count: int, progress: Progress) -> None:
    """Write the sharpest frame of each of at most ``count`` stretches of equal motion of a video, upright, with square
    pixels and without black borders, as JPEG.

    Files are numbered by their frames in the video. Of several videos in a file, the largest is used and reported.

    Raises:
        SceneError: the file cannot be read as a video, or holds no frame.
    """
    with _opened(video) as (container, stream):
        transfer, aspect = _hdr(video, stream), _pixel_aspect(stream)
        is_around = round(stream.width * aspect) == 2 * stream.height
        measured = _measured(video, container, stream, progress)
    # The picture of a panorama moves to all sides at once.
    moved = PANORAMAS_PER_SECOND * STEP * measured.since if is_around else measured.moved
    chosen = sharpest(measured.sharpnesses, *stretches(moved, measured.since, count))
    down, right = (0, 0) if is_around else (2 * width for width in borders(measured.brightest))
    if down or right:
        notice(
            f"{video} has black borders, of {down} pixels above and below and {right} at the left and the right, which "
            "are cut off."
        )
    task = progress.add_task("keeping the sharpest", total=len(chosen))
    before, held = None, 0
    with _opened(video) as (container, stream):
        for number, frame in enumerate(_frames(container, stream)):
            if number in chosen:
                progress.advance(task)
                small = _small(frame).astype(np.float32)
                if before is not None and before.shape == small.shape and show_the_same(before, small):
                    held += 1
                    continue
                before = small
                if frame.interlaced_frame:
                    notice(
                        f"{video} is interlaced: where something moves, every other line of a frame is interpolated, "
                        "since it was taken at another moment; record progressive video (25p, not 50i) if you can."
                    )
                image = _upright(frame, transfer, aspect, (right, down, frame.width - right, frame.height - down))
                image.save(folder / f"frame_{number:06d}.jpg", quality=95, subsampling=0)
    if held:
        notice(
            f"{held} of {len(chosen)} frames of {video} repeat the frame before, where the picture stands still, and "
            "are left out."
        )


def _small(frame: av.VideoFrame) -> UInt8[np.ndarray, "H W"]:
    height = max(1, round(_SMALL * frame.height / frame.width))
    return frame.reformat(_SMALL, height, format="gray", interpolation="AREA").to_ndarray()


@dataclass(frozen=True, eq=False)
class _Measured:
    """What the first pass over a video measures.

    Attributes:
        sharpnesses: of each frame, of :func:`sharpness`.
        since: seconds of each frame since the first.
        moved: path of the picture up to each frame, of :func:`travelled`.
        brightest: of each pixel the brightest that any frame shows, at half the size.
    """

    sharpnesses: Float[np.ndarray, " N"]
    since: Float[np.ndarray, " N"]
    moved: Float[np.ndarray, " N"]
    brightest: UInt8[np.ndarray, "H W"]


def _measured(
    video: Path, container: av.container.InputContainer, stream: VideoStream, progress: Progress
) -> _Measured:
    task = progress.add_task("looking for sharp frames", total=stream.frames or None)
    usual = 1 / float(stream.average_rate or 30)
    sharpnesses, times, marks, shifts, before, last, end = [], [], [], [], None, None, 0.0
    brightest: UInt8[np.ndarray, "H W"] | None = None
    for frame in _frames(container, stream):
        half = frame.reformat(frame.width // 2, frame.height // 2, format="gray").to_ndarray()
        sharpnesses.append(sharpness(half))
        if brightest is None or brightest.shape == half.shape:
            brightest = half if brightest is None else np.maximum(brightest, half)
        else:  # files of several sizes were joined
            brightest = np.full((1, 1), 255, np.uint8)
        step = usual if frame.time is None or last is None else frame.time - last
        # Times begin anew where files were joined, and jump after a break.
        times.append(times[-1] + (step if 0 < step < _PAUSE else usual) if times else 0.0)
        last, end = frame.time, max(end, (frame.time or 0.0) + max(usual, frame.duration * (frame.time_base or 0)))
        if not marks or times[-1] >= marks[-1] + _PACE:
            small = _small(frame)
            marks.append(times[-1])
            shifts.append(shift(small if before is None or before.shape != small.shape else before, small))
            before = small
        progress.update(task, completed=len(times))
    if brightest is None:
        raise SceneError(f"{video} holds no frames: is it a complete video?")
    _tell_of_a_cut(video, stream, float(end))
    since = np.array(times)
    moved = np.interp(since, marks, travelled(np.array(shifts)))
    return _Measured(np.array(sharpnesses), since, moved, brightest)


def first_frame(video: Path) -> av.VideoFrame | None:
    """The first frame of a video, if it has one."""
    with _opened(video) as (container, stream):
        return next(_frames(container, stream), None)


def sharpness(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Variance of the Laplacian."""
    return float(cv2.Laplacian(grey, cv2.CV_32F, borderType=cv2.BORDER_REFLECT).var())


def shift(before: UInt8[np.ndarray, "H W"], after: UInt8[np.ndarray, "H W"]) -> Float[np.ndarray, " 2"]:
    """Shift of the picture between two frames, down and to the right, in widths.

    By phase correlation (Kuglin and Hines 1975), whose peak a parabola refines.
    """
    window = np.outer(np.hanning(before.shape[0]), np.hanning(before.shape[1]))
    after_, before_ = (np.fft.rfft2(window * (grey - grey.mean())) for grey in (after, before))
    cross = after_ * before_.conj()
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), before.shape)
    row, column = np.unravel_index(peak.argmax(), peak.shape)
    return np.array([_refined(peak[:, column], row), _refined(peak[row], column)]) / before.shape[1]


def _refined(values: Float[np.ndarray, " N"], at: np.integer) -> float:
    """Position of the peak of periodic values, between -N/2 and N/2."""
    left, top, right = values[at - 1], values[at], values[(at + 1) % len(values)]
    offset = 0.5 * (left - right) / min(left - 2 * top + right, -1e-12)
    half = len(values) // 2
    return (float(at) + half) % len(values) - half + float(np.clip(offset, -0.5, 0.5))


def travelled(shifts: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Length of the picture's path up to each mark, without the hand's shake, which cancels out within a second."""
    return np.cumsum(np.linalg.norm(uniform_filter1d(shifts, round(1 / _PACE), axis=0), axis=1))


def stretches(
    moved: Float[np.ndarray, " N"], since: Float[np.ndarray, " N"], count: int
) -> tuple[Float[np.ndarray, " N"], int]:
    """Progress of each frame from 0 to 1, of motion and a little of time, and the number of stretches to cut it into.

    There are at most ``count``, at most five a second, at least one a second, and otherwise one for each :data:`STEP`.

    Args:
        moved: path of the picture in widths, of :func:`travelled`.
        since: seconds since the first frame.
        count: maximum number.
    """
    by_time, by_motion = (x / max(x[-1], 1e-6) for x in (since, moved - moved[0]))
    wanted = max(since[-1], by_motion[-1] * (moved[-1] - moved[0]) / STEP)
    number = max(1, min(count, round(FRAMES_PER_SECOND * since[-1]), round(wanted)))
    return (_BY_TIME * by_time + (1 - _BY_TIME) * by_motion) / (_BY_TIME + (1 - _BY_TIME) * by_motion[-1]), number


def sharpest(sharpnesses: Float[np.ndarray, " N"], progress: Float[np.ndarray, " N"], count: int) -> set[int]:
    """Indices of the sharpest frame in each of ``count`` equal stretches of a progress from 0 to 1.

    Sharpness is relative to the median of neighbouring frames, or a blurred textured wall would beat a sharp plain one.
    """
    relative = sharpnesses / np.maximum(median_filter(sharpnesses, _NEIGHBOURHOOD), 1e-6)
    # The small offset keeps rounding from moving a frame on a border into the stretch before.
    stretch = np.minimum(progress * count + 1e-6, count - 1).astype(int)
    members = (np.flatnonzero(stretch == k) for k in range(count))
    return {int(m[relative[m].argmax()]) for m in members if len(m)}


@contextmanager
def _opened(video: Path) -> Iterator[tuple[av.container.InputContainer, VideoStream]]:
    try:
        # Absolute, or FFmpeg takes what is before a colon for a protocol, as in 2024-05-01T12:30:00.mp4.
        with av.open(str(video.absolute())) as container:
            if container.format.name == "tty":  # FFmpeg draws what is written, as a film
                raise av.error.InvalidDataError(0, "it is text")
            stream = _main_stream(video, container.streams.video)
            stream.thread_type = "AUTO"
            yield container, stream
    except av.error.FFmpegError as error:
        raise SceneError(
            f"{video} cannot be read as a video ({error.strerror}): give a video or a folder of photographs; if it is "
            "a video, copy it again, or convert it to mp4"
        ) from error


def _frames(container: av.container.InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Frames of a video, without damaged packets, as players show it; their share is reported."""
    packets = damaged = 0
    for packet in container.demux(stream):
        packets += 1
        try:
            yield from packet.decode()
        except av.error.InvalidDataError:
            damaged += 1
    if damaged:
        notice(
            f"{damaged / packets:.1%} of the video {container.name} is damaged, and is left out: copy it again if "
            "you have an intact file."
        )


def _tell_of_a_cut(video: Path, stream: VideoStream, end: float) -> None:
    """Report a video that ends before the time in its header, for formats that have one."""
    start, whole = (float((each or 0) * (stream.time_base or 0)) for each in (stream.start_time, stream.duration))
    seconds = end - start
    if stream.container.format.name.startswith(_TIMED) and seconds < _WHOLE * whole:
        notice(
            f"{video} ends after {seconds:.1f} of its {whole:.1f} seconds, like a truncated copy: copy it again if "
            "you have the whole file."
        )


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


def _pixel_aspect(stream: VideoStream) -> float:
    """Width of a pixel by its height: 4/3 in HDV and some AVCHD, whose 1440 columns are shown as 1920."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return aspect if 0.25 < aspect < 4 and abs(aspect - 1) > _SQUARE else 1.0


def borders(brightest: UInt8[np.ndarray, "H W"]) -> tuple[int, int]:
    """Rows above and below, and columns at the left and the right, that are black borders: as wide on both sides.

    Args:
        brightest: of each pixel the brightest that any frame shows.
    """
    shown = brightest > _BLACK
    widths = []
    for axis in (1, 0):
        lines = np.flatnonzero(shown.any(axis=axis))
        size = shown.shape[1 - axis]
        before, after = (lines[0], size - 1 - lines[-1]) if len(lines) else (0, 0)
        whole = before > 1 and abs(int(before) - int(after)) <= 1 and len(lines) > size / 4
        widths.append(int(max(before, after)) + 1 if whole else 0)  # and the line in which both are mixed
    return widths[0], widths[1]


def _upright(
    frame: av.VideoFrame, transfer: Transfer | None, aspect: float, kept: tuple[int, int, int, int]
) -> Image.Image:
    if transfer is None:
        hd = frame.width >= 1280 or frame.height > 576
        # FFmpeg takes what does not say so for BT.601, where players take HD for BT.709.
        untagged = frame.colorspace == _UNTAGGED
        image = frame.to_image(src_colorspace="ITU709" if hd and untagged else None)
        image = Image.fromarray(narrowed(np.asarray(image), frame.color_primaries))
    else:
        image = Image.fromarray(tone_mapped(frame.to_ndarray(format="rgb48le"), transfer))
    if frame.interlaced_frame and _is_combed(pixels := np.asarray(image)):
        image = Image.fromarray(_first_field(pixels))
    image = image.crop(kept)
    if aspect != 1:
        image = image.resize((round(image.width * aspect), image.height), Image.Resampling.BICUBIC)
    angle = frame.rotation
    if (matrix := _display_matrix(frame)) is not None and np.linalg.det(matrix) < 0:  # FFmpeg's angle is without it
        image = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        angle = float(np.degrees(np.arctan2(matrix[0, 1], -matrix[0, 0])))
    return image.rotate(angle, expand=True)


def _display_matrix(frame: av.VideoFrame) -> Float[np.ndarray, "2 2"] | None:
    """How the picture is turned or mirrored for display, for row vectors; None if it is not."""
    stored = frame.side_data.get("DISPLAYMATRIX")
    return None if stored is None else np.frombuffer(bytes(stored), np.int32).reshape(3, 3)[:2, :2] / 2**16


def _is_combed(pixels: UInt8[np.ndarray, "H W 3"]) -> bool:
    """Whether every other line is of another moment: lines are less like the next than like the one after it."""
    lines = pixels.mean(axis=2, dtype=np.float32)
    return bool(np.abs(lines[2:] - lines[1:-1]).mean() > np.abs(lines[2:] - lines[:-2]).mean())


def _first_field(pixels: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """The picture of its even lines, with the others interpolated."""
    even = pixels[::2].astype(np.uint16)
    below = np.concatenate([even[1:], even[-1:]])
    whole = pixels.copy()
    whole[1::2] = ((even + below + 1) // 2)[: len(whole[1::2])]
    return whole
