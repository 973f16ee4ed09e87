"""The kit for a machine without a network: what it leaves out, and its parts put together again."""

from __future__ import annotations

import re
import subprocess
import tarfile
from pathlib import Path

import pytest

from benchmarks import gpu_kit


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    (tmp_path / "machine.txt").write_text("# a machine\nTorch==2.11.0+cu130\nPyYAML @ file:///wheels/pyyaml\n")
    return tmp_path / "machine.txt"


def test_what_is_there_is_left_out_by_any_spelling_of_its_name_and_what_comes_with_torch(machine: Path):
    packages = ["nvidia-cublas==13.4", "pyyaml==6.0", "pi_heif==1.4.0", "torch==2.15", "svg.path==7.1"]
    there = gpu_kit.installed(machine)
    assert gpu_kit.without(packages, there | {"svg-path"}) == ["pi_heif==1.4.0"]


def test_parts_put_together_are_the_archive_and_none_is_larger_than_was_said(tmp_path: Path):
    folder, kit = tmp_path / "folder", tmp_path / "kit"
    (folder / "wheels").mkdir(parents=True)
    kit.mkdir()
    contents = bytes(range(256)) * (5 << 12)
    (folder / "wheels/a.whl").write_bytes(contents)
    assert gpu_kit.pack(folder, kit, 2) == 3
    parts = sorted(kit.iterdir())
    assert max(part.stat().st_size for part in parts) == 2 << 20
    (tmp_path / "kit.tar").write_bytes(b"".join(part.read_bytes() for part in parts))
    with tarfile.open(tmp_path / "kit.tar") as tar:
        file = tar.extractfile("wheels/a.whl")
        assert file is not None
        assert file.read() == contents


def test_the_facade_of_the_tests_is_packed_where_the_script_says_it_is(machine: Path, monkeypatch):
    """There, nothing could make it."""
    folder = machine.parent
    for name in ("imported", "download", "build_own", "copy_scene"):
        monkeypatch.setattr(gpu_kit, name, lambda *_: [])
    gpu_kit.main(folder / "kit", folder, there=machine)
    for part in sorted((folder / "kit").glob("kit.tar.part-*")):
        with (folder / "kit.tar").open("ab") as file:
            file.write(part.read_bytes())
    with tarfile.open(folder / "kit.tar") as tar:
        names = tar.getnames()
    (said,) = re.findall(r'SHELLGS_SMOKE_SCENE="\$PWD/(\w+)"', gpu_kit.RUN)
    assert {f"{said}/cues/{kind}/manifest.json" for kind in ("shell", "truth")} <= {*names}


def test_the_script_is_one_that_sh_can_read(tmp_path: Path):
    (tmp_path / "run.sh").write_text(gpu_kit.RUN)
    subprocess.run(["sh", "-n", tmp_path / "run.sh"], check=True)
