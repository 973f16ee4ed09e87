"""Cue maps on disk: read as written, and refused with a reason if they do not belong to the camera."""

from __future__ import annotations

import errno
import gc
import json
import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.cue_maps import CueMaps, relative_path
from shellgs_method.files.map_files import CueMap
from shellgs_method.geometry.camera import Camera

HEIGHT, WIDTH = 12, 16
VIEW = "images/a.jpg"


def a_camera(dtype: torch.dtype = torch.float64) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [10, 70, -5], degrees=True).as_matrix())
    viewmat[:3, 3] = torch.tensor([3.0, -1.0, 8.0])
    K = torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat.to(dtype), K.to(dtype), WIDTH, HEIGHT)


def a_map(seed: int = 0) -> CueMap:
    random = np.random.default_rng(seed)
    depth = random.uniform(5, 15, (HEIGHT, WIDTH)).astype(np.float32)
    depth[:4] = 0
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float16)
    normal[4:, :, 2] = -1
    return CueMap(depth, normal, depth > 0)


def equal(a: CueMap | None, b: CueMap) -> bool:
    return a is not None and all(
        np.array_equal(getattr(a, key), getattr(b, key)) for key in ("depth", "normal", "mask")
    )


@pytest.fixture
def maps(tmp_path: Path) -> CueMaps:
    """A set with one map, of VIEW, made from a shell and an alignment."""
    shell, alignment = tmp_path / "shell" / "facade.ply", tmp_path / "shell" / "alignment.json"
    shell.parent.mkdir()
    shell.write_bytes(b"a shell")
    alignment.write_bytes(b"an alignment")
    maps = CueMaps.create(
        tmp_path, "shell", command="shellgs cast {scene}", sources=[shell, alignment], metres_per_unit=2.5
    )
    maps.write(VIEW, a_map(), a_camera())
    return CueMaps.open(tmp_path, "shell")


def map_file(maps: CueMaps) -> Path:
    return maps.folder / f"{VIEW}.npz"


def rewrite(maps: CueMaps, **changes: np.ndarray) -> None:
    """Change arrays of VIEW's file directly."""
    with np.load(map_file(maps)) as file:
        arrays = dict(file)
    np.savez_compressed(map_file(maps), **{**arrays, **changes})


def refusal(maps: CueMaps, camera: Camera | None = None) -> str:
    """The refusal of VIEW's map, which always names the view and the command that makes it again."""
    with pytest.raises(SceneError) as caught:
        maps.read(VIEW, camera or a_camera())
    message = str(caught.value)
    assert VIEW in message
    assert f"`shellgs cast {maps.scene}" in message
    return message


def test_a_map_is_read_as_it_was_written(maps: CueMaps):
    assert equal(maps.read(VIEW, a_camera()), a_map())


@pytest.fixture
def busy_threads() -> Iterator[None]:
    """Garbage is collected all the time, and another thread runs whenever it is."""

    def let_others_run(*_) -> None:
        time.sleep(1e-4)

    before = gc.get_threshold()
    gc.callbacks.append(let_others_run)
    gc.set_threshold(20)
    yield
    gc.callbacks.remove(let_others_run)
    gc.set_threshold(*before)


def test_threads_at_different_depths_of_their_stacks_can_read_at_once(maps: CueMaps, busy_threads):
    """As nerfstudio's, which load a scene: Python 3.11 cannot parse the headers of two arrays at once."""

    def read(depth: int) -> list[CueMap | None]:
        return read(depth - 1) if depth else [maps.read(VIEW, a_camera()) for _ in range(20)]

    with ThreadPoolExecutor(4) as threads:
        assert all(equal(cue, a_map()) for cues in threads.map(read, (0, 10, 20, 30)) for cue in cues)


def test_the_manifest_is_read_as_it_was_written(maps: CueMaps):
    assert maps.manifest.metres_per_unit == 2.5
    assert sorted(maps.manifest.sources) == ["shell/alignment.json", "shell/facade.ply"]
    assert json.loads((maps.folder / "manifest.json").read_text())["command"] == "shellgs cast {scene}"


def test_a_view_without_a_map_has_none(maps: CueMaps):
    assert maps.read("images/b.jpg", a_camera()) is None
    with pytest.raises(SceneError, match=r"view 'images/b.jpg' has no shell map: run `shellgs cast"):
        maps.require("images/b.jpg", a_camera())


def test_the_record_has_the_supported_share(maps: CueMaps):
    record = maps.record(VIEW)
    assert record is not None
    assert record.supported == pytest.approx(8 / 12)


@pytest.mark.parametrize(
    "others",
    [("images/b/x.jpg", "images/a/x.jpg"), ("x.jpg", "x.png"), ("x.jpg", "x"), ("Straße 1/é ö.jpg", "漢 字.png")],
)
def test_names_that_resemble_each_other_keep_their_own_maps(tmp_path: Path, others: tuple[str, str]):
    maps = CueMaps.create(tmp_path, "shell", command="shellgs cast {scene}")
    for seed, name in enumerate(others):
        maps.write(name, a_map(seed), a_camera())
    maps = CueMaps.open(tmp_path, "shell")
    assert maps.names == sorted(others)
    for seed, name in enumerate(others):
        assert equal(maps.read(name, a_camera()), a_map(seed))


@pytest.mark.parametrize("name", ["../x.jpg", "/x.jpg", ""])
def test_a_name_outside_the_scene_is_refused(maps: CueMaps, name: str):
    with pytest.raises(SceneError, match="inside the scene"):
        maps.read(name, a_camera())


def test_a_pose_that_went_through_float32_is_accepted(maps: CueMaps):
    assert maps.read(VIEW, a_camera(torch.float32)) is not None


def test_a_map_of_another_size_is_refused(maps: CueMaps):
    assert "it is 16x12 pixels, the camera 8x6" in refusal(maps, a_camera().shrunk(8))


def test_a_map_of_other_intrinsics_is_refused(maps: CueMaps):
    camera = a_camera()
    K = camera.K.clone()
    K[0, 0] += 0.5
    assert "intrinsics differ from the camera's by 0.5 pixels" in refusal(maps, replace(camera, K=K))


def test_a_map_of_a_turned_camera_is_refused(maps: CueMaps):
    viewmat = a_camera().viewmat.clone()
    turn = torch.from_numpy(Rotation.from_euler("y", 0.1, degrees=True).as_matrix())
    viewmat[:3] = turn @ viewmat[:3]  # about the camera's centre, which stays
    assert "turned by 0.1 degrees" in refusal(maps, replace(a_camera(), viewmat=viewmat))


def test_a_map_of_a_moved_camera_is_refused(maps: CueMaps):
    viewmat = a_camera().viewmat.clone()
    viewmat[0, 3] += 0.05
    assert "stood 0.05 scene units away" in refusal(maps, replace(a_camera(), viewmat=viewmat))


def test_a_camera_that_is_not_finite_is_refused(maps: CueMaps):
    refusal(maps, replace(a_camera(), viewmat=torch.full((4, 4), math.nan)))


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_a_truncated_file_is_refused(maps: CueMaps, kept: float):
    content = map_file(maps).read_bytes()
    map_file(maps).write_bytes(content[: int(kept * len(content))])
    assert "damaged" in refusal(maps)
    assert "damaged" in refusal(CueMaps.open(maps.scene, "shell"))


def test_a_file_with_a_flipped_byte_is_refused(maps: CueMaps):
    content = bytearray(map_file(maps).read_bytes())
    content[200] ^= 0xFF  # inside the compressed depth
    map_file(maps).write_bytes(content)
    assert "damaged" in refusal(maps)


def test_a_pickle_is_refused_unopened(maps: CueMaps):
    rewrite(maps, depth=np.array([{"a": 1}], dtype=object))
    assert "damaged" in refusal(maps)


def test_a_file_without_a_record_is_refused(maps: CueMaps):
    np.savez_compressed(map_file(maps), depth=a_map().depth)
    assert "damaged" in refusal(maps)


@pytest.mark.parametrize(
    ("key", "array", "words"),
    [
        ("depth", np.zeros((HEIGHT, WIDTH)), "its depth is float64"),
        ("normal", np.zeros((HEIGHT, WIDTH, 3), np.float32), "its normal is float32"),
        ("mask", np.zeros((HEIGHT, WIDTH), np.uint8), "its mask is uint8"),
        ("mask", np.zeros((HEIGHT, WIDTH - 1), bool), "its mask is bool [12, 15], not bool [12, 16]"),
        ("depth", np.full((HEIGHT, WIDTH), np.nan, np.float32), "NaN"),
        ("normal", np.full((HEIGHT, WIDTH, 3), np.inf, np.float16), "infinite"),
        ("depth", np.full((HEIGHT, WIDTH), -1, np.float32), "negative depths"),
        ("mask", np.ones((HEIGHT, WIDTH), bool), "pixels of the mask without depth"),
    ],
)
def test_invalid_arrays_are_refused(maps: CueMaps, key: str, array: np.ndarray, words: str):
    rewrite(maps, **{key: array})
    assert words in refusal(maps)


def test_invalid_arrays_are_not_stored(maps: CueMaps):
    with pytest.raises(SceneError, match=r"images/b\.jpg.*NaN"):
        maps.write("images/b.jpg", replace(a_map(), depth=np.full((HEIGHT, WIDTH), np.nan, np.float32)), a_camera())
    assert not (maps.folder / "images/b.jpg.npz").exists()


def test_a_map_of_another_view_is_refused(maps: CueMaps):
    (maps.folder / "images/b.jpg.npz").write_bytes(map_file(maps).read_bytes())
    with pytest.raises(SceneError, match=rf"'images/b.jpg' .* it is that of '{VIEW}'; run `shellgs cast"):
        CueMaps.open(maps.scene, "shell").read("images/b.jpg", a_camera())


@pytest.mark.parametrize("source", ["shell/facade.ply", "shell/alignment.json"])
def test_maps_of_a_changed_source_are_refused(maps: CueMaps, source: str):
    (maps.scene / source).write_bytes(b"changed")
    assert f"{source} has changed" in refusal(maps)


def test_maps_whose_sources_are_gone_are_read(maps: CueMaps):
    for source in maps.manifest.sources:
        (maps.scene / source).unlink()
    assert maps.read(VIEW, a_camera()) is not None


def test_a_map_left_over_from_another_alignment_is_refused(maps: CueMaps):
    alignment = maps.scene / "shell" / "alignment.json"
    alignment.write_bytes(b"another")
    sources = [maps.scene / "shell" / "facade.ply", alignment]
    again = CueMaps.create(maps.scene, "shell", command="shellgs cast {scene}", sources=sources)
    assert "another shell/alignment.json" in refusal(again)


def test_only_a_valid_map_of_the_same_camera_is_current(maps: CueMaps):
    assert maps.current(VIEW, a_camera())
    assert not maps.current("images/b.jpg", a_camera())
    assert not maps.current(VIEW, a_camera().shrunk(8))
    map_file(maps).write_bytes(b"")
    assert not maps.current(VIEW, a_camera())


def test_writing_again_replaces_a_damaged_map(maps: CueMaps):
    map_file(maps).write_bytes(b"PK")
    maps.write(VIEW, a_map(), a_camera())
    assert equal(maps.read(VIEW, a_camera()), a_map())


def test_an_empty_map_is_stored(maps: CueMaps):
    nothing = CueMap(*(np.zeros_like(array) for array in (a_map().depth, a_map().normal, a_map().mask)))
    maps.write("images/sky.jpg", nothing, a_camera())
    assert equal(maps.read("images/sky.jpg", a_camera()), nothing)


def test_opening_a_set_that_does_not_exist_is_refused(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no shell maps"):
        CueMaps.open(tmp_path, "shell")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"command": "x", "unheard_of": 1}', '{"command": "x", "format": 99}'])
def test_a_manifest_that_cannot_be_read_is_refused_by_name(maps: CueMaps, text: str):
    (maps.folder / "manifest.json").write_text(text)
    with pytest.raises(SceneError, match=r"cues/shell/manifest\.json"):
        CueMaps.open(maps.scene, "shell")


def test_a_moved_scene_keeps_its_maps(maps: CueMaps, tmp_path: Path):
    moved = tmp_path.rename(tmp_path.with_name("moved scene"))
    maps = CueMaps.open(moved, "shell")
    assert maps.read(VIEW, a_camera()) is not None
    with pytest.raises(SceneError, match=r"`shellgs cast '.*moved scene' --max-image-size 8`"):
        maps.read(VIEW, a_camera().shrunk(8))


@pytest.mark.parametrize("interruption", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_an_interrupted_write_keeps_the_earlier_file(tmp_path: Path, interruption: BaseException):
    path = tmp_path / "x.bin"
    path.write_bytes(b"before")

    def write_half() -> None:
        with atomic_write(path) as file:
            file.write(b"half")
            raise interruption

    with pytest.raises(type(interruption)):
        write_half()
    assert [p.name for p in tmp_path.iterdir()] == ["x.bin"]
    assert path.read_bytes() == b"before"


def test_a_full_disk_names_the_file(tmp_path: Path):
    with pytest.raises(OSError, match=r"No space left.*x\.bin"), atomic_write(tmp_path / "x.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_reader_keeps_the_file_it_opened(tmp_path: Path):
    path = tmp_path / "x.bin"
    path.write_bytes(b"before")
    with path.open("rb") as reader:
        with atomic_write(path) as file:
            file.write(b"after")
        assert reader.read() == b"before"
    assert path.read_bytes() == b"after"


@pytest.mark.parametrize("link", ["masks", "masks/left"])
def test_a_folder_that_is_a_link_or_has_one_is_a_source_like_any_other(tmp_path: Path, link: str):
    scene, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    (scene / link).parent.mkdir(parents=True)
    elsewhere.mkdir()
    (elsewhere / "a.png").write_bytes(b"a mask")
    (scene / link).symlink_to(elsewhere)
    maps = CueMaps.create(scene, "shell", command="shellgs cast {scene}", sources=[scene / "masks"])
    maps.write(VIEW, a_map(), a_camera())
    moved = scene.rename(tmp_path / "moved")
    assert equal(CueMaps.open(moved, "shell").read(VIEW, a_camera()), a_map())
    (elsewhere / "a.png").write_bytes(b"another")
    assert "masks has changed since" in refusal(CueMaps.open(moved, "shell"))


def test_a_path_is_relative_to_the_scene_that_it_is_in_and_else_absolute(tmp_path: Path):
    scene, other = tmp_path / "scene", tmp_path / "other.ply"
    (scene / "shell").mkdir(parents=True)
    other.touch()
    (scene / "shell/linked.ply").symlink_to(other)
    (tmp_path / "link").symlink_to(scene)
    for inside in (scene / "shell/linked.ply", tmp_path / "link/shell/linked.ply"):
        assert relative_path(inside, inside.parents[1]) == "shell/linked.ply"
    assert relative_path(scene / "shell/../shell/own.ply", tmp_path / "link") == "shell/own.ply"
    for outside in (other, scene / "../other.ply"):
        assert relative_path(outside, scene) == str(other.resolve())
