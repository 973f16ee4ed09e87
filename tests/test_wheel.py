"""The built wheel, without the repository: what `pip install shellgs` gives a user."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(*words: object, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([*map(str, words)], cwd=cwd, env=environment, text=True, capture_output=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_wheel_runs_the_demo_outside_the_repository(tmp_path):
    source, venv = tmp_path / "source", tmp_path / "venv"
    for name in ("dataparsers", "shellgs_method"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("method_configs.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip")
    build = "from setuptools.build_meta import build_sdist; build_sdist('..')"
    run(sys.executable, "-c", build, cwd=source)
    (archive,) = tmp_path.glob("shellgs-*.tar.gz")  # the wheel is built from what the source distribution holds
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, archive, cwd=tmp_path)
    run(sys.executable, "-m", "venv", "--without-pip", venv, cwd=tmp_path)
    (wheel,) = tmp_path.glob("shellgs-*.whl")
    run(*pip, "--python", venv, "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)

    (packages,) = venv.glob("[Ll]ib/**/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])  # not 8 GB of them once more
    scripts = venv / Path(sys.executable).parent.name
    shutil.copy(Path(sys.executable).with_name("ns-train"), scripts)
    where = "import shellgs_method, method_configs; print(shellgs_method.__file__, method_configs.__file__)"
    assert all(Path(path).is_relative_to(venv) for path in run(scripts / "python", "-c", where, cwd=tmp_path).split())

    size = ("--iterations", 20, "--width", 64, "--height", 48, "--views", 10)
    run(scripts / "shellgs", "demo", *size, cwd=tmp_path)
    table = (tmp_path / "demo" / "results.md").read_text()
    assert all(word in table for word in ("photo-gs", "shellgs-metric", "PSNR", "Normal (°)"))
    command = (tmp_path / "demo" / "runs").rglob("config.yml")
    assert len([*command]) == 2
