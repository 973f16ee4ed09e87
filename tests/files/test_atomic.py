"""Hashes of files, which are kept for large ones, and files that are written as a whole."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import struct
from pathlib import Path

import pytest

from shellgs_method.errors import SceneError
from shellgs_method.files import atomic


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that counts as large and as unchanged for long."""
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(atomic, "_LARGE", 0)
    monkeypatch.setattr(atomic, "_SETTLED", -1e18)
    (tmp_path / "scan.laz").write_bytes(b"points")
    return tmp_path / "scan.laz"


def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "_hashed", lambda path: pytest.fail(f"{path} is read"))


def test_a_large_file_is_hashed_once(scan: Path, monkeypatch: pytest.MonkeyPatch):
    expected = hashlib.sha256(b"points").hexdigest()
    assert atomic.content_hash(scan) == expected
    unread(monkeypatch)
    assert atomic.content_hash(scan) == expected


@pytest.mark.parametrize("keep_times", [False, True])
def test_a_changed_file_is_hashed_again(scan: Path, keep_times: bool):
    before, stat = atomic.content_hash(scan), scan.stat()
    scan.write_bytes(b"Points")  # as long as before
    if keep_times:
        os.utime(scan, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert atomic.content_hash(scan) == hashlib.sha256(b"Points").hexdigest() != before


def test_a_touched_file_is_hashed_again(scan: Path, monkeypatch: pytest.MonkeyPatch):
    expected = atomic.content_hash(scan)
    os.utime(scan, (1, 1))
    read: list[Path] = []
    monkeypatch.setattr(atomic, "_hashed", lambda path: read.append(path) or expected)
    assert atomic.content_hash(scan) == expected
    assert read == [scan]


def test_a_file_just_written_is_hashed_each_time(scan: Path, monkeypatch: pytest.MonkeyPatch):
    """It may be written again within one step of the file system's clock."""
    monkeypatch.setattr(atomic, "_SETTLED", 2_000_000_000)
    atomic.content_hash(scan)
    assert not list(scan.parent.glob("cache/hashes/*"))


@pytest.mark.parametrize("damage", [b"", b"[]", b'{"state": 1}'])
def test_a_damaged_cache_is_made_again(scan: Path, damage: bytes):
    expected = atomic.content_hash(scan)
    (kept,) = scan.parent.glob("cache/hashes/*.json")
    kept.write_bytes(damage)
    assert atomic.content_hash(scan) == expected
    assert expected.encode() in kept.read_bytes()


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_the_hash_of_a_gltf_is_of_the_files_beside_it_too(tmp_path: Path, suffix: str):
    path, buffer = tmp_path / f"a.{suffix}", tmp_path / "a b.bin"
    text = json.dumps({"buffers": [{"uri": "a%20b.bin"}, {"uri": "data:,c"}, {"byteLength": 4}]}).encode()
    path.write_bytes(text if suffix == "gltf" else struct.pack("<4sIII4s", b"glTF", 2, 0, len(text), b"JSON") + text)
    hashes = set()
    for data in (b"one", b"two"):
        buffer.write_bytes(data)
        hashes |= {atomic.content_hash(path), atomic.content_hash(path)}
    assert len(hashes) == 2
    buffer.unlink()
    assert atomic.content_hash(path) == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("data", [b"", b"glTF", b"{", b"[]", b'{"buffers": [1, {"uri": 2}]}', b"\xff"])
def test_a_damaged_gltf_has_the_hash_of_its_bytes(tmp_path: Path, data: bytes):
    (tmp_path / "a.gltf").write_bytes(data)
    assert atomic.content_hash(tmp_path / "a.gltf") == hashlib.sha256(data).hexdigest()


def test_contents_replace_those_of_the_same_names_once_they_are_complete(tmp_path: Path):
    folder = tmp_path / "made"
    for name in ("a/old", "b/other", "page"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("old")
    with pytest.raises(FileNotFoundError), atomic.atomic_contents(folder) as complete:
        (complete / "page").rename(complete / "interrupted")
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == {"a", "a/old", "b", "b/other", "page"}
    with atomic.atomic_contents(folder) as complete:
        (complete / "a").mkdir()
        (complete / "a/new").write_text("new")
        (complete / "page").write_text("new")
    everything = {"a", "a/new", "a/old", "b", "b/other", "page"}
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == everything
    assert (folder / "page").read_text() == "new"


def test_a_folder_that_is_a_link_to_nothing_is_refused(tmp_path: Path):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(SceneError, match="nowhere, which does not exist"), atomic.atomic_contents(tmp_path / "link"):
        pass


def fill(folder: Path, names: tuple[str, ...], content: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


@pytest.mark.parametrize(("there", "made"), [("a", "a/b"), ("a/b", "a")])
def test_a_file_in_the_place_of_a_folder_is_refused_before_anything_is_replaced(tmp_path: Path, there: str, made: str):
    folder = tmp_path / "made"
    fill(folder, (there, "first"), "old")
    with pytest.raises(SceneError, match=r"made/a is in the way"), atomic.atomic_contents(folder) as complete:
        fill(complete, (made, "first"), "new")
    assert (folder / "first").read_text() == "old"


def test_a_file_that_cannot_be_written_is_named_by_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not by that of the temporary file, which a read-only disk refuses to open and also to delete."""

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match="Read-only") as raised:
        atomic.write_whole(tmp_path / "manifest.json", "{}")
    assert raised.value.filename == str(tmp_path / "manifest.json")
