"""The plan of the package: imports go down the list of rooms in pyproject.toml, and plain rooms need no nerfstudio."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = (ROOT / "pyproject.toml").read_text()


def listed(name: str) -> list[str]:
    """Modules of the package in a list of pyproject.toml, without its name."""
    return re.findall(r"shellgs_method\.([\w.]+)", PROJECT.partition(f"{name} = [")[2].partition("]")[0])


ROOMS, PLAIN = listed("layers"), listed("source_modules")


def entries(folder: Path) -> set[str]:
    return {
        path.stem for path in folder.iterdir() if path.stem[0] not in "._" and (path.is_dir() or path.suffix == ".py")
    }


def test_every_module_is_in_a_room_and_every_room_is_in_the_list():
    assert sorted(ROOMS) == sorted(entries(ROOT / "shellgs_method"))


def test_tests_are_found_by_the_name_of_the_room():
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name[0] not in "._"}
    assert folders <= {*ROOMS, "dataparsers"}


def test_plain_rooms_are_imported_without_nerfstudio():
    folders = [(ROOT / "shellgs_method").joinpath(*room.split(".")) for room in PLAIN]
    paths = [path for folder in folders for path in folder.rglob("*.py") if not path.stem.endswith(("__", "_script"))]
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]
    code = f"import sys, {', '.join(modules)}; print([name for name in sys.modules if name.startswith('nerfstudio')])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
