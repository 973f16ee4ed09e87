"""Frames of videos: which are taken, as players show them, in the colours of photographs."""

from __future__ import annotations

import zlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition
from PIL import Image, ImageFilter
from rich.progress import Progress
from scenes import PHONE, is_red, photograph, write_video
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as translated

from shellgs_method.capture import capture
from shellgs_method.capture.frames import extract_frames, first_frame, sharpest, shift, stretches, travelled
from shellgs_method.capture.photographs import add_photograph
from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import read_image
from shellgs_method.files.transfer import linear_of, srgb, tone_mapped

QUIET = Progress(disable=True)


def turn_video(path: Path, *rows: int) -> None:
    """Set the display matrix of an mp4, of which the first two numbers of the first two rows are given."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # after version, flags, times, track, duration, layer and volume
    a, b, c, d = ((value << 16).to_bytes(4, "big", signed=True) for value in rows)
    data[matrix : matrix + 24] = a + b + bytes(4) + c + d + bytes(4)
    path.write_bytes(data)


def numbers(folder: Path) -> list[int]:
    return sorted(int(path.stem.removeprefix("frame_")) for path in folder.iterdir())


def test_no_blurred_frame_of_a_video_is_extracted(tmp_path):
    blurred = {k for k in range(40) if k % 4 != k // 10}
    wide = photograph(480, 96)
    frames = [wide.crop((8 * k, 0, 8 * k + 160, 96)) for k in range(40)]
    write_video(
        tmp_path / "walk.mp4",
        [f.filter(ImageFilter.GaussianBlur(3)) if k in blurred else f for k, f in enumerate(frames)],
    )
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 8, QUIET)
    taken = numbers(tmp_path / "frames")
    assert len(taken) == 8
    assert not blurred & set(taken)


def test_frames_that_a_video_holds_are_extracted_once_and_this_is_told(tmp_path, caplog):
    """As a slide show does, at whose steps many frames are taken; a picture that creeps is no still."""
    wide = photograph(480, 96).resize((960, 192))
    stills = [wide.crop((160 * k, 0, 160 * k + 320, 192)) for k in range(4)]
    creeping = [wide.resize((1920, 384)).crop((k, 0, 640 + k, 384)).resize((320, 192)) for k in range(40)]
    for name, frames in {"show": [still for still in stills for _ in range(30)], "slow": creeping}.items():
        write_video(tmp_path / f"{name}.mp4", frames)
        (tmp_path / name).mkdir()
        extract_frames(tmp_path / f"{name}.mp4", tmp_path / name, 200, QUIET)
    assert {number // 30 for number in numbers(tmp_path / "show")} == {0, 1, 2, 3}
    assert len(numbers(tmp_path / "show")) == 4
    assert "show.mp4 repeat the frame before" in caplog.text
    assert len(numbers(tmp_path / "slow")) > 3
    assert "slow.mp4" not in caplog.text


def test_a_video_named_by_its_time_is_read_from_its_own_folder(tmp_path, monkeypatch):
    """FFmpeg takes what is before a colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    video = Path("2024-05-01T12:30:00.mp4")
    write_video(tmp_path / "walk.mp4", [photograph(160, 96)] * 3)
    (tmp_path / "walk.mp4").rename(video)
    frame = first_frame(video)
    assert frame is not None
    assert (frame.width, frame.height) == (160, 96)


def test_sharpness_is_relative_to_the_neighbourhood():
    # A textured stretch, then a plain one; every frame of the first is sharper than any of the second.
    sharpnesses = np.concatenate([np.full(50, 100.0), np.full(50, 1.0)])
    sharpnesses[[20, 70]] *= 1.5
    assert sharpest(sharpnesses, np.linspace(0, 1, 100), 2) == {20, 70}


def test_a_damaged_packet_of_a_video_is_left_out_and_this_is_told(tmp_path, caplog):
    path = tmp_path / "walk.mp4"
    wide = photograph(480, 96)
    write_video(path, [wide.crop((8 * k, 0, 8 * k + 160, 96)) for k in range(20)])
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    with path.open("r+b") as file:
        file.seek(packets[10][0])
        file.write(bytes(packets[10][1]))
    (tmp_path / "frames").mkdir()
    extract_frames(path, tmp_path / "frames", 4, QUIET)
    assert len(numbers(tmp_path / "frames")) == 4
    assert "walk.mp4 is damaged, and is left out" in caplog.text


@pytest.mark.parametrize(("share", "still", "told"), [(0.5, 1, True), (1.0, 1, False), (1.0, 20, False)])
def test_a_video_that_was_cut_off_is_told(tmp_path, caplog, share, still, told):
    """As a download of which the rest is missing, behind a header of all its frames; not one that stands at its end."""
    path, wide = tmp_path / "walk.mp4", photograph(480, 96)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        frames = [av.VideoFrame.from_image(wide.crop((8 * k, 0, 8 * k + 160, 96))) for k in range(41 - still)]
        packets = [packet for frame in [*frames, None] for packet in stream.encode(frame)]
        packets[-1].duration = still
        container.mux(packets)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    (tmp_path / "frames").mkdir()
    extract_frames(path, tmp_path / "frames", 10, QUIET)
    assert ("of its 4.0 seconds, like a truncated copy" in caplog.text) == told


@pytest.mark.parametrize(
    ("kept", "size"),
    [
        ((0, 24, 160, 72), (160, 44)),  # a wide film in a frame of 5:3
        ((50, 0, 110, 96), (56, 96)),  # one held upright
        ((40, 20, 120, 76), (76, 52)),
        ((0, 40, 160, 96), (160, 96)),  # a dark sky
        ((0, 0, 160, 96), (160, 96)),
    ],
)
def test_black_borders_of_a_video_are_cut_off_and_this_is_told(tmp_path, caplog, kept, size):
    wide = photograph(480, 96).point([60 + level // 2 for level in range(256)] * 3)
    frames = [Image.new("RGB", (160, 96)) for _ in range(20)]
    for k, frame in enumerate(frames):
        frame.paste(wide.crop((8 * k, 0, 8 * k + 160, 96)).crop(kept), kept[:2])
    write_video(tmp_path / "walk.mp4", frames)
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 4, QUIET)
    with Image.open(next((tmp_path / "frames").iterdir())) as image:
        assert image.size == size
        edges = np.asarray(image.convert("L"))
    assert ("walk.mp4 has black borders" in caplog.text) == (size != (160, 96))
    if size != (160, 96):
        assert min(edges[0].mean(), edges[-1].mean(), edges[:, 0].mean(), edges[:, -1].mean()) > 50


def test_times_that_begin_anew_or_jump_in_a_video_change_nothing(tmp_path):
    wide = photograph(640, 96)
    frames = [wide.crop((8 * k, 0, 8 * k + 160, 96)) for k in range(60)]
    write_video(tmp_path / "whole.ts", frames)
    for name, part in (("1.ts", frames[:30]), ("2.ts", frames[30:])):
        write_video(tmp_path / name, part)
    (tmp_path / "joined.ts").write_bytes(b"".join((tmp_path / name).read_bytes() for name in ("1.ts", "2.ts")))
    with av.open(str(tmp_path / "broken.mkv"), "w") as container:  # recorded on an hour later
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 160, 96, "yuv420p", 8_000_000
        for k, frame in enumerate(map(av.VideoFrame.from_image, frames)):
            frame.pts, frame.time_base = 100 * k + 3_600_000 * (k >= 30), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    taken = []
    for video in ("whole.ts", "joined.ts", "broken.mkv"):
        (tmp_path / video[:-3]).mkdir()
        extract_frames(tmp_path / video, tmp_path / video[:-3], 200, QUIET)
        taken.append(len(numbers(tmp_path / video[:-3])))
    assert taken[0] > 15
    np.testing.assert_allclose(taken, taken[0], atol=1)


def test_a_video_of_frames_of_several_sizes_is_read(tmp_path):
    wide = photograph(480, 160)
    for name, (width, height) in (("1.ts", (160, 96)), ("2.ts", (96, 160))):
        write_video(tmp_path / name, [wide.crop((8 * k, 0, 8 * k + width, height)) for k in range(20)])
    (tmp_path / "joined.ts").write_bytes(b"".join((tmp_path / name).read_bytes() for name in ("1.ts", "2.ts")))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "joined.ts", tmp_path / "frames", 10, QUIET)
    sizes = [Image.open(path).size for path in sorted((tmp_path / "frames").iterdir())]
    assert {*sizes} == {(160, 96), (96, 160)}


def test_a_video_gives_between_one_and_five_frames_a_second():
    since = np.arange(60) / 30
    assert stretches(np.linspace(0, 9, 60), since, 200)[1] == 10
    assert stretches(np.zeros(60), since, 200)[1] == 2
    assert stretches(np.linspace(0, 0.3, 60), since, 200)[1] == 6  # 0.3 widths in steps of 0.05
    assert stretches(np.linspace(0, 9, 60), since, 7)[1] == 7


@pytest.mark.parametrize("moved", [(0, 3), (2, -5), (-6.4, 20.7)])
def test_the_shift_of_a_picture_is_found(moved):
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(300, 400)), 3)
    grey = 255 * (noise - noise.min()) / np.ptp(noise)
    before, after = (translated(grey, by)[100:172, 100:228].astype(np.uint8) for by in ((0, 0), moved))
    np.testing.assert_allclose(128 * shift(before, after), moved, atol=0.7)


def test_a_shake_is_no_way_and_a_walk_is():
    shake = np.diff(np.random.default_rng(0).normal(0, 0.02, (301, 2)), axis=0)
    assert travelled(shake)[-1] < 0.25 * np.linalg.norm(shake, axis=1).sum()
    assert travelled(shake + np.array([0, 0.03]))[-1] == pytest.approx(9, rel=0.1)


def test_frames_are_spread_by_motion(tmp_path):
    """A walk of 40 frames that stands still for the middle 20."""
    noise = np.asarray(photograph(480, 96, seed=1).filter(ImageFilter.GaussianBlur(2)))
    at = np.concatenate([np.arange(10) * 12, np.full(20, 120), 120 + np.arange(10) * 12])
    write_video(tmp_path / "walk.mp4", [Image.fromarray(noise[:, x : x + 160]) for x in at], rate=10)
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 10, QUIET)
    taken = np.array(numbers(tmp_path / "frames"))
    assert len(taken) == 10
    assert ((taken >= 10) & (taken < 30)).sum() <= 3  # by time alone it is five


@pytest.mark.parametrize(
    ("matrix", "size", "red"),
    [
        ((0, 1, -1, 0), (48, 64), (44, 4)),  # clockwise by 90 degrees, as phones held upright write it
        ((-1, 0, 0, -1), (64, 48), (60, 44)),
        ((-1, 0, 0, 1), (64, 48), (60, 4)),  # mirrored, as phones write it of their front cameras
        ((1, 0, 0, -1), (64, 48), (4, 44)),
        ((0, 1, 1, 0), (48, 64), (4, 4)),
        ((0, -1, -1, 0), (48, 64), (44, 60)),
    ],
)
def test_frames_of_a_video_are_turned_and_mirrored_as_players_show_them(tmp_path, matrix, size, red):
    write_video(tmp_path / "walk.mp4", [photograph(64, 48)] * 3, rate=2)
    turn_video(tmp_path / "walk.mp4", *matrix)
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 3, QUIET)
    with Image.open(next((tmp_path / "frames").iterdir())) as frame:
        assert frame.size == size
        assert is_red(frame, *red)


def test_hd_video_that_does_not_say_its_colours_is_of_bt_709(tmp_path):
    colour, matrix = (40, 180, 60), {"ITU709": 1280, "ITU601": 640}
    for name, width in matrix.items():
        with av.open(str(tmp_path / "a.mp4"), "w") as container:
            stream = container.add_stream("mpeg4", rate=5)
            stream.width, stream.height, stream.pix_fmt = width, 96, "yuv420p"
            frame = av.VideoFrame.from_image(Image.new("RGB", (width, 96), colour))
            for _ in range(3):
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=name)))
            container.mux(stream.encode())
        (tmp_path / name).mkdir()
        extract_frames(tmp_path / "a.mp4", tmp_path / name, 1, QUIET)
        with Image.open(next((tmp_path / name).iterdir())) as shown:
            np.testing.assert_allclose(np.asarray(shown).mean(axis=(0, 1)), colour, atol=4)


def to_xyz(primaries: list[tuple[float, float]]) -> np.ndarray:
    """From linear RGB of primaries, by their chromaticities, to XYZ, whose white is D65 (SMPTE RP 177)."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in primaries]).T
    white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
    return columns * np.linalg.solve(columns, white)


BT709 = to_xyz([(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)])
WIDER = {
    1: BT709,
    9: to_xyz([(0.708, 0.292), (0.170, 0.797), (0.131, 0.046)]),  # BT.2020
    12: to_xyz([(0.68, 0.32), (0.265, 0.69), (0.15, 0.06)]),  # P3 of displays and phones
}


@pytest.mark.parametrize("primaries", WIDER)
def test_colours_of_a_video_of_wider_primaries_are_converted(tmp_path, primaries):
    """As screen recordings and some phones have them, without being HDR."""
    shown = np.array([200, 90, 60])
    wide = srgb(np.linalg.solve(WIDER[primaries], BT709 @ linear_of(shown / 255)))
    with av.open(str(tmp_path / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.color_primaries = primaries
        stored = av.VideoFrame.from_image(Image.new("RGB", (64, 48), tuple(np.rint(255 * wide).astype(int))))
        for frame in [*[stored] * 5, None]:
            container.mux(stream.encode(frame))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 3, QUIET)
    with Image.open(next((tmp_path / "frames").iterdir())) as frame:
        np.testing.assert_allclose(np.asarray(frame).mean(axis=(0, 1)), shown, atol=4)


@pytest.mark.parametrize("name", ["a.avif", "a.png", "a.heic"])
def test_a_photograph_of_p3_by_its_codes_is_converted(tmp_path, name):
    """Without a profile: as encoders of AVIF, PNG and HEIF write it."""
    path, p3 = tmp_path / name, 12
    if path.suffix == ".heic":
        path.write_bytes(PHONE.read_bytes().replace(b"colrnclx\0\x01\0\x0d", b"colrnclx\0\x0c\0\x0d"))
        stored = np.asarray(read_image(PHONE))[8, 8]
    else:
        stored = np.array([190, 95, 67])
        _of_codes(path, Image.new("RGB", (32, 24), tuple(stored)), p3, 13)
    shown = 255 * srgb(np.clip(np.linalg.solve(BT709, WIDER[p3] @ linear_of(stored / 255)), 0, 1))
    assert np.abs(shown - stored).max() > 4
    np.testing.assert_allclose(np.asarray(read_image(path))[8, 8], shown, atol=3)
    add_photograph(path, tmp_path / "captured.png")
    np.testing.assert_allclose(np.asarray(read_image(tmp_path / "captured.png"))[8, 8], shown, atol=3)


def add_streams(path: Path, *streams: tuple[tuple[int, int], int, dict[str, object]]) -> None:
    """A file of several video streams: size, number of frames and properties of each; blue but for the last, red."""
    with av.open(str(path), "w") as container:
        added = []
        for size, count, properties in streams:
            is_cover = "disposition" in properties
            stream = container.add_stream("mjpeg" if is_cover else "mpeg4", rate=5)
            stream.width, stream.height, stream.pix_fmt = *size, "yuvj420p" if is_cover else "yuv420p"
            for name, value in properties.items():
                setattr(stream if name == "disposition" else stream.codec_context, name, value)
            added.append((stream, size, count))
        for stream, size, count in added:
            colour = "red" if stream is added[-1][0] else "blue"
            for _ in range(count):
                container.mux(stream.encode(av.VideoFrame.from_image(Image.new("RGB", size, colour))))
            container.mux(stream.encode())


@pytest.mark.parametrize(
    "first",
    [((32, 24), 5, {}), ((128, 96), 1, {}), ((128, 96), 1, {"disposition": Disposition.attached_pic})],
    ids=["proxy", "picture", "cover"],
)
def test_frames_are_of_the_largest_video_not_of_a_proxy_or_cover(tmp_path, caplog, first):
    add_streams(tmp_path / "walk.mp4", first, ((64, 48), 5, {}))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 3, QUIET)
    with Image.open(next((tmp_path / "frames").iterdir())) as frame:
        assert frame.size == (64, 48)
        assert is_red(frame, 30, 30)
    assert ("holds 2 videos of 32x24, 64x48 pixels: 64x48 is used" in caplog.text) == (first[0] == (32, 24))


def test_a_file_of_a_cover_alone_is_refused(tmp_path):
    add_streams(tmp_path / "song.mp4", ((64, 48), 1, {}))
    with pytest.raises(SceneError, match=r"song.mp4 holds no video, but 1 pictures"):
        extract_frames(tmp_path / "song.mp4", tmp_path, 3, QUIET)


# ITU-R BT.2408: 18 % grey is at 38 % of both, diffuse white at 75 % of HLG, 58 % of PQ.
@pytest.mark.parametrize(("transfer", "grey", "white"), [("HLG", 0.38, 0.75), ("PQ", 0.38, 0.58)])
def test_greys_of_hdr_are_as_bright_as_in_a_photograph(transfer, grey, white):
    codes = np.array([0, grey, white, 0.9, 1.0])
    mapped = tone_mapped(np.rint(65535 * np.tile(codes[:, None], (1, 1, 3))).astype(np.uint16), transfer)[0]
    assert (mapped == mapped[:, :1]).all()
    assert mapped[0, 0] == 0
    assert mapped[1, 0] == pytest.approx(255 * (1.055 * (26 / 203) ** (1 / 2.4) - 0.055), abs=2)  # 26 of 203 nits
    assert 225 < mapped[2, 0] < mapped[3, 0] < mapped[4, 0] + 1 <= 256  # highlights stay brighter than white


def test_colours_of_hdr_below_the_knee_are_those_that_were_encoded():
    colours = np.array([[200, 40, 30], [20, 120, 60], [30, 40, 150], [90, 90, 90]])
    linear = ((colours / 255 + 0.055) / 1.055) ** 2.4 * 203 / 10000
    wide = linear @ np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]).T
    power = wide ** (2610 / 16384)  # PQ's inverse EOTF (ITU-R BT.2100)
    codes = ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    np.testing.assert_allclose(tone_mapped(np.rint(65535 * codes[None]).astype(np.uint16), "PQ")[0], colours, atol=1)


@pytest.mark.parametrize(("characteristic", "name"), [(18, "HLG"), (16, "PQ"), (1, None)])
def test_an_hdr_video_is_tone_mapped_and_this_is_told(tmp_path, caplog, characteristic, name):
    white = Image.new("RGB", (64, 48), (191, 191, 191))  # 75 %: diffuse white of HLG, four times that of PQ
    with av.open(str(tmp_path / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx265", rate=5, options={"x265-params": "log-level=none"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p10le"
        stream.codec_context.color_trc = characteristic
        for frame in [*[av.VideoFrame.from_image(white)] * 5, None]:
            container.mux(stream.encode(frame))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 3, QUIET)
    assert (f"is HDR ({name}), and its frames are tone-mapped" in caplog.text) == (name is not None)
    with Image.open(next((tmp_path / "frames").iterdir())) as frame:
        assert frame.size == (64, 48)
        assert np.asarray(frame).mean() == pytest.approx({"HLG": 233, "PQ": 255, None: 191}[name], abs=3)


def test_an_hdr_photograph_is_tone_mapped_and_this_is_told(caplog):
    read_image(PHONE)
    assert "HDR" not in caplog.text
    pixels = np.asarray(read_image(PHONE.with_name("hlg.heic"))).astype(int)
    assert "holds HDR photographs (HLG), which are tone-mapped" in caplog.text
    codes = np.array([[0.38] * 3, [0.75] * 3, [0.9] * 3, [0.5, 0.2, 0.2]])  # of its four patches, in 10 bits
    expected = tone_mapped(np.rint(65535 * codes[None]).astype(np.uint16), "HLG")[0].astype(int)
    np.testing.assert_allclose(pixels[16, 8::16], expected, atol=2)


def test_8_bits_of_an_hdr_photograph_are_tone_mapped_too(tmp_path):
    sdr, hlg = b"colrnclx\0\x01\0\x0d", b"colrnclx\0\x09\0\x12"  # primaries and transfer
    (tmp_path / "hlg.heic").write_bytes(PHONE.read_bytes().replace(sdr, hlg))
    plain, mapped = (np.asarray(read_image(path)) for path in (PHONE, tmp_path / "hlg.heic"))
    wide = plain.astype(np.uint16) * 257
    np.testing.assert_allclose(mapped.astype(int), tone_mapped(wide, "HLG").astype(int), atol=1)


def _of_codes(path: Path, shown: Image.Image, primaries: int, transfer: int) -> None:
    """Write a photograph that says, as AVIF and PNG do, what its colours are, by codes of ITU-T H.273."""
    shown.save(path, quality=100)
    content = path.read_bytes()
    if path.suffix == ".avif":
        head, mark, rest = content.partition(b"colrnclx")
        path.write_bytes(head + mark + bytes([0, primaries, 0, transfer]) + rest[4:])
        return
    chunk = b"cICP" + bytes([primaries, transfer, 0, 1])
    chunk = b"\0\0\0\x04" + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    path.write_bytes(content[:33] + chunk + content[33:])  # after the header


@pytest.mark.parametrize("suffix", [".avif", ".png"])
def test_an_hdr_photograph_of_any_format_is_tone_mapped(tmp_path, caplog, suffix):
    shown = Image.new("RGB", (32, 24), (97, 97, 97))  # 38 %: 18 % grey of PQ
    shown.save(tmp_path / f"sdr{suffix}")
    assert np.asarray(read_image(tmp_path / f"sdr{suffix}")).mean() == pytest.approx(97, abs=1)
    assert not caplog.records
    _of_codes(tmp_path / f"hdr{suffix}", shown, 9, 16)
    expected = tone_mapped(np.full((1, 1, 3), 97 * 257, np.uint16), "PQ").mean()
    assert np.asarray(read_image(tmp_path / f"hdr{suffix}")).mean() == pytest.approx(expected, abs=3)
    assert "holds HDR photographs (PQ), which are tone-mapped" in caplog.text


def test_an_hdr_png_is_captured_in_srgb(tmp_path):
    _of_codes(tmp_path / "hdr.png", Image.new("RGB", (32, 24), (97, 97, 97)), 9, 16)
    add_photograph(tmp_path / "hdr.png", tmp_path / "captured.png")
    with Image.open(tmp_path / "captured.png") as captured:
        mapped = tone_mapped(np.full((1, 1, 3), 97 * 257, np.uint16), "PQ")
        assert (np.asarray(captured) == mapped).all()
    assert (np.asarray(read_image(tmp_path / "captured.png")) == mapped).all()


def test_the_curve_of_srgb_and_its_inverse_agree():
    stored = np.arange(256) / 255
    np.testing.assert_allclose(srgb(linear_of(stored)), stored, atol=1e-7)
    assert linear_of(np.array([0.5]))[0] == pytest.approx(0.21404114, abs=1e-7)  # IEC 61966-2-1


@pytest.mark.parametrize(("flags", "told"), [("interlaced=1:tff=1:", True), ("", False)])
def test_a_frame_of_an_interlaced_video_is_of_one_moment(tmp_path, caplog, flags, told):
    wide = np.asarray(photograph().resize((96, 48), Image.Resampling.BICUBIC))
    first, second = wide[:, :64], wide[:, 12:76]  # the camera moves by 12 pixels within a frame
    combed = first.copy()
    combed[1::2] = second[1::2]
    with av.open(str(tmp_path / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"x264-params": f"{flags}qp=1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        for frame in [*[av.VideoFrame.from_ndarray(np.ascontiguousarray(combed))] * 5, None]:
            container.mux(stream.encode(frame))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 1, QUIET)
    with Image.open(next((tmp_path / "frames").iterdir())) as image:
        off = np.abs(np.asarray(image).astype(int) - first).mean()
    assert (off < 8) == told
    assert ("is interlaced: where something moves" in caplog.text) == told


def test_frames_of_a_video_whose_pixels_are_not_square_are_as_wide_as_they_are_shown(tmp_path):
    write_video(tmp_path / "hdv.mp4", [photograph(96, 72)] * 8, pixel_aspect=Fraction(4, 3))
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "hdv.mp4", tmp_path / "frames", 3, QUIET)
    sizes = set()
    for path in (tmp_path / "frames").iterdir():
        with Image.open(path) as image:
            sizes.add(image.size)
    assert sizes == {(128, 72)}


@pytest.mark.parametrize(
    ("name", "content"), [("walk.mp4", b""), ("walk.mp4", b"this is no video" * 100), ("picks.txt", b"1 2 3\n" * 100)]
)
def test_a_file_that_is_no_video_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=rf"{name} cannot be read as a video"):
        capture(tmp_path / name, tmp_path / "scene")
    assert not (tmp_path / "scene" / "images").exists()


def test_one_photograph_in_place_of_a_folder_is_refused(tmp_path):
    photograph(96, 72).save(tmp_path / "a.JPG")
    with pytest.raises(SceneError, match=r"a\.JPG is one photograph: give a folder"):
        capture(tmp_path / "a.JPG", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
