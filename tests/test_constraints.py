"""The tested versions in constraints.txt are allowed by pyproject.toml."""

from __future__ import annotations

import re
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


def test_every_dependency_has_an_allowed_version():
    lines = (line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#"))
    tested = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    project = (ROOT / "pyproject.toml").read_text().partition("[project.scripts]")[0]
    needed = [
        Requirement(text) for text in re.findall(r'"([a-z][^"]*[=<>][^"]*)"', project.partition("dependencies")[2])
    ]
    assert len(needed) > 20
    for each in (each for each in needed if each.marker is None or each.marker.evaluate({"python_version": "3.11"})):
        assert each.specifier.contains(tested[canonicalize_name(each.name)]), each
