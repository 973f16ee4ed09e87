"""Pack what a machine with a GPU, Python and torch, but no network, needs to test and time training.

    python -m benchmarks.gpu_kit kit/ scene/ --python 3.12 --there machine.txt

`machine.txt` is what `pip freeze` prints there; without it, torch with what it depends on, numpy and scipy are left
out. Copy the folder there, and run `sh kit/run.sh`: it compiles gsplat's kernels, runs the tests that need a GPU and
`benchmarks.gpu`, and writes all that they print to `kit/results.txt`. What is installed lies in the kit's own folder.
On a machine without a GPU it shows that nothing is missing: the tests are skipped, and torch's backend is timed.

The scene's shell must be cast (`shellgs cast`). The packages are those that are imported here by
training steps.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Optional

import tyro

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.errors import SceneError, refusals_end_the_program
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.synthetic import FacadeConfig, write_scene

ROOT = Path(__file__).parents[1]
TORCH = ("torch", "numpy", "scipy")
UNUSED = ("shellgs", "transformers")
"""Packages to leave out: this one is built anew, and the other is imported only where it is, with all it asks for."""
IMPORTED = """
import runpy, sys
from importlib.metadata import packages_distributions, version
import pytest
runpy.run_module("benchmarks.gpu", run_name="__main__", alter_sys=True)
named = packages_distributions()
names = {name for module in sys.modules for name in named.get(module.partition(".")[0], ())}
print("packages:", *(f"{name}=={version(name)}" for name in sorted(names)))
"""
SMALL = ("--n", "2000", "--rounds", "1", "--methods", "photo-gs", "shellgs-metric")
"""A benchmark that imports what all do."""
RUN = """#!/bin/sh
# Test and time training on this machine; what is printed goes to results.txt too.
cd "$(dirname "$0")" || exit 1
python=${PYTHON:-python3}
cat kit.tar.part-* | tar x || exit 1
[ -d site ] || $python -m pip install -q --no-index --no-deps --target site wheels/*.whl || exit 1
export PYTHONPATH="$PWD/site:$PWD/code" SHELLGS_SMOKE_SCENE="$PWD/facade"
{
    $python -c 'import sys, torch; print(sys.version, torch.__version__, torch.version.cuda)'
    $python -c 'import torch; print(torch.cuda.is_available() and torch.cuda.get_device_name())'
    cd code
    $python -m pytest -q -rs -p no:cacheprovider $(grep -lr cuda.is_available --include 'test_*.py' tests)
    $python -m benchmarks.gpu ../scene --out ../results.json "$@"
    cd ..
    cat results.json
} 2>&1 | tee results.txt
"""


def main(
    kit: Annotated[Path, tyro.conf.Positional],
    scene: Annotated[Path, tyro.conf.Positional],
    python: str = f"{sys.version_info.major}.{sys.version_info.minor}",
    there: Optional[Path] = None,
    megabytes: int = 60,
) -> None:
    """Write the kit.

    Args:
        kit: Folder for the kit.
        scene: Scene folder whose shell is cast.
        python: Version of Python there.
        there: Packages that are there, as `pip freeze` prints them. If not set: torch, numpy and scipy.
        megabytes: Largest size of a part.
    """
    if kit.exists() and any(kit.iterdir()):
        raise SceneError(f"{kit} is not empty: give another folder, or remove it first")
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        packages = without(imported(scene), installed(there) | {*UNUSED})
        download(packages, python, folder / "wheels")
        build_own(folder / "wheels")
        copy_code(folder / "code")
        copy_scene(scene, folder / "scene")
        write_facade(folder / "facade")
        kit.mkdir(parents=True, exist_ok=True)
        parts = pack(folder, kit, megabytes)
    (kit / "run.sh").write_text(RUN)
    print(f"{len(packages) + 1} packages in {parts} parts: copy {kit} there, and run `sh {kit.name}/run.sh`")


def imported(scene: Path) -> list[str]:
    """The packages that training steps and their tests import, as NAME==VERSION."""
    words = [sys.executable, "-c", IMPORTED, str(scene.resolve()), *SMALL]
    process = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return re.findall(r"^packages: (.*)$", process.stdout, re.MULTILINE)[0].split()


def installed(there: Path | None) -> set[str]:
    """Names of the packages that are there already; torch brings its own, such as nvidia's."""
    if there is not None:
        return {_name(line) for line in there.read_text().splitlines() if re.match(r"\w", line)}
    names, of_torch = {*TORCH}, subprocess.check_output([sys.executable, "-m", "pip", "show", "torch"], text=True)
    requires = re.findall(r"^Requires: (.*)$", of_torch, re.MULTILINE)[0]
    return names | {_name(name) for name in requires.split(",")} | {"cuda-pathfinder", "mpmath", "markupsafe"}


def without(packages: Iterable[str], names: set[str]) -> list[str]:
    """The packages but for some; nvidia's always come with torch."""
    return [each for each in packages if _name(each) not in names and not _name(each).startswith(("nvidia-", "cuda-"))]


def _name(requirement: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\s=<>!@\[;]", requirement.strip())[0]).lower()


def download(packages: Iterable[str], python: str, folder: Path) -> None:
    """Fetch wheels for another Python; of a package whose version has none, the newest version that has."""
    platforms = [f"--platform=manylinux{tag}_x86_64" for tag in ("2014", "_2_17", "_2_28")]
    words = ["--no-deps", "--only-binary=:all:", f"--python-version={python}", *platforms, "-q", "-d", str(folder)]
    fetch = [sys.executable, "-m", "pip", "download", *words]
    for package in packages:
        choices = package, package.partition("==")[0]
        if all(subprocess.run([*fetch, choice], check=False).returncode for choice in choices):
            raise SceneError(
                f"{package} has no wheel for Python {python}: bring it another way, and name it in the file of --there"
            )


def build_own(folder: Path) -> None:
    """Add the wheel of this project."""
    words = ["wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder), str(ROOT)]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True)


def copy_code(folder: Path) -> None:
    """The tests and benchmarks, and the settings of the tests; the package itself is installed."""
    for name in ("tests", "benchmarks"):
        ignored = shutil.ignore_patterns("__pycache__", "results")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)


def copy_scene(scene: Path, folder: Path) -> None:
    """A scene without the folder of its capture, which training does not read."""
    shutil.copytree(scene, folder, ignore=lambda path, names: {"capture"} & {*names} if Path(path) == scene else set())


def write_facade(scene: Path) -> None:
    """Write the scene of the tests, which takes Open3D: 10 views of 48 x 32 pixels, with shell and truth maps."""
    write_scene(scene, FacadeConfig(width=48, height=32, views=10, points=300, supersampling=1))
    views = read_views(FacadeDataParserConfig(data=scene))
    cast_views(PlacedShell.load(scene, views, Alignment.load(scene / ALIGNMENT)))


def pack(folder: Path, kit: Path, megabytes: int) -> int:
    """Write all as one archive in parts; return their number."""
    archive = kit / "kit.tar"
    with tarfile.open(archive, "w", dereference=True) as tar:
        for path in sorted(folder.iterdir()):
            tar.add(path, path.name)
    size, number = megabytes << 20, 0
    with archive.open("rb") as file:
        while chunk := file.read(size):
            (kit / f"kit.tar.part-{number:03d}").write_bytes(chunk)
            number += 1
    os.remove(archive)
    return number


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(main)
