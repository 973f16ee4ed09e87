"""Inputs with traits that public bug reports describe, run as a user would: each works, or one sentence says why not.

The cases are not part of the project: `SHELLGS_CASES` is their folder. Each has a `run.sh` that makes inputs from a
scene and runs commands on them; ``$ command`` precedes the output of each, ``== input`` how its maps differ from the
ordinary ones. ``pytest -m slow -s tests/test_cases.py`` prints the table of all inputs.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

CASES = Path(os.environ.get("SHELLGS_CASES", Path(__file__).parents[2] / "shared" / "cases"))
DEMO = ("demo", "small", "--iterations", "60", "--width", "64", "--height", "48", "--views", "10")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CASES.is_dir(), reason=f"no cases in {CASES}; set SHELLGS_CASES to their folder"),
]

WORKS = r"views cast|Verdict: (good|doubtful)|green is confirmed|Printing profiling stats|difference \d"
"""What a command says that went through."""
MOVED = """
import importlib, importlib.abc, importlib.util, sys

class Moved(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    names = {
        "dataparsers.cue_maps": "shellgs_method.files.cue_maps",
        "dataparsers.photograph": "shellgs_method.files.photographs",
    }
    def find_spec(self, name, path, target=None):
        return importlib.util.spec_from_loader(name, self) if name in self.names else None
    def create_module(self, spec):
        return importlib.import_module(self.names[spec.name])
    def exec_module(self, module):
        pass

sys.meta_path.insert(0, Moved())
"""
"""Modules by the names that the cases know them by."""
CRASH = re.compile(
    r"Traceback \(most recent|Aborted|Segmentation fault|core dumped|terminate called|ModuleNotFoundError"
)
NEAR = 0.005
"""Largest difference in metres, at the 95th percentile, of maps that are the same."""
MESHED = 0.4
"""That of a cloud of 8000 points in place of the mesh."""


def refused(why: str) -> str:
    """Pattern of a refusal that names the cause."""
    return rf"shellgs: (?:[^\n]|\n(?!\n))*{why}"


RIGHT: dict[str, dict[str, str | float]] = {
    "01-images-txt-without-blank-lines": {"cast": r"10 views cast"},
    "02-small-first-model": {"ns-train": WORKS, "": r"sparse/1, the largest, is used.*(\n.*)*2 of 10 photographs"},
    "04-e57-phantom-zeros": {"s-ordinary ": WORKS, "cast": r"left out \d+ of \d+ points"},
    "06-glb-compressed": {
        "draco.glb": refused("KHR_draco_mesh_compression"),
        "meshopt.glb": refused("EXT_meshopt_compression"),
    },
    "07-obj-six-digits": {
        r"cast.*(six|metres)\.": refused("stored in steps of"),
        "cast.*eight": r"stored in steps of 0.01 x 0.1 x .*are up to half of that off",
        "align": r"Steps of the coordinates(.|\n)*doubtful",
        "== eight$": 0.05,
        "== eightcloud": MESHED,
    },
    "08-gcp-in-degrees": {"ordinary.txt": WORKS, "": refused("in degrees")},
    "09-gcp-text-forms": {
        r"/(ordinary|bom|tabs|apostrophe|case|stem|windows|geo-ordinary|geo-case)\.txt": WORKS,
        "utf16": refused("save it as UTF-8"),
        "": refused(r"expected|is not a photograph|name no photograph|photographs?"),
    },
    "10-masks": {
        "labels": refused("holds the values"),
        "dynamic": refused("invert"),
        "(onlyone|typo)": r"no mask in|views cast",
    },
    "12-heic": {
        # Read, and too small for SfM, or nearly.
        "(allheic|mixed) ": r"cameras of only \d of 10 photographs were found|[6-9] of 10 photographs registered"
        r"|show too few points to find their cameras",
        "raw": refused("are raw photographs"),
        "videos": refused("there are no photographs"),
    },
    "15-colmap-camera-models": {"SPHERICAL": refused("SPHERICAL"), "": refused("undistort")},
    "16-text-clouds": {"decimal": refused("decimal commas")},
    "17-splat-as-shell": {"": refused("Gaussian splats")},
    "19-ply-variants": {"== (uvcloud|faces0|int64|cloud)": MESHED},
    "22-points-in-another-frame": {"(ordinary|cast)": WORKS, "": refused("are not in the frame of the cameras")},
    "23-pcd": {"==": MESHED},
    "26-exif-orientation": {
        r"stored.*shown\.txt": refused("(cannot be triangulated|pixels must be of photographs of that size)"),
        "capture": refused("cameras of only 0 of 10 photographs were found"),  # read, and too small for SfM
    },
    "31-georeferenced-colmap": {
        "align.*tj": r"double precision or with more digits(.|\n)*the alignment is refused",
        "cast.*tj": refused("(no camera sees the shell|was found for other cameras)"),
    },
    "32-vertex-at-the-origin": {"cast.*(triangle|spike)": r"absurdly far away"},
}
"""For each case what is right, by patterns of the command or input: what it must say, or the largest
difference of its maps in metres. Other commands must work, other maps be the ordinary ones."""


@dataclass(frozen=True)
class Outcome:
    """What became of one input.

    Attributes:
        heading: the command, or the name of the input whose maps are compared.
        text: its output.
        right: what is right.
    """

    heading: str
    text: str
    right: str | float

    @property
    def difference(self) -> float | None:
        """Difference in metres of the maps from the ordinary ones, at the 95th percentile."""
        found = re.search(r"95 % ([\d.]+) m", self.text)
        return float(found[1]) if found else None

    @property
    def fault(self) -> str:
        """What is wrong; empty if nothing is."""
        if CRASH.search(self.text):
            return "crash"
        if isinstance(self.right, float):
            off = self.difference
            return f"maps are {off} m off" if off is not None and not off <= self.right else ""
        return "" if re.search(str(self.right), self.text) else f"does not say {self.right!r}"

    @property
    def words(self) -> str:
        """What became of it, in a line of the table."""
        if isinstance(self.right, float):
            return "refused before" if self.difference is None else f"95 % of the maps within {self.difference:.4f} m"
        sentence = re.search(r"shellgs: (.*)", self.text, re.S)
        return "refused: " + " ".join(sentence[1].split())[:200] if sentence else "works"


def outcomes(case: str, output: str) -> Iterator[Outcome]:
    """The outcome of each command and comparison in the output of a case."""
    right = RIGHT.get(case, {})
    parts = re.split(r"^(\$ .*|== .*)$", output, flags=re.M)[1:]
    for heading, text in zip(parts[::2], parts[1::2], strict=True):
        compares = heading.startswith("==")
        known = (v for end, v in right.items() if isinstance(v, float) == compares and re.search(end, heading))
        yield Outcome(heading, text, next(known, NEAR if compares else WORKS))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    subprocess.run([Path(sys.executable).with_name("shellgs"), *DEMO], cwd=folder, check=True, capture_output=True)
    return folder / "small" / "scene"


@pytest.mark.parametrize("case", sorted(path.parent.name for path in CASES.glob("*/run.sh")))
def test_each_input_works_or_is_refused_by_the_cause(demo, tmp_path, case):
    (tmp_path / "sitecustomize.py").write_text(MOVED)
    environment = os.environ | {
        "VENV": sys.prefix,
        "LIMIT": "600",
        "EXTRA": f"{tmp_path}:{os.environ.get('EXTRA', '')}",
    }
    done = subprocess.run(
        ["sh", CASES / case / "run.sh", demo, tmp_path / "work"], env=environment, capture_output=True, text=True
    )
    found = list(outcomes(case, done.stdout.replace(str(tmp_path), "")))
    assert found, done.stdout + done.stderr
    print(f"\n{case}")
    for outcome in found:
        print(f"  {outcome.heading[:90]} | {outcome.fault or outcome.words}")
    assert not [outcome for outcome in found if outcome.fault]
