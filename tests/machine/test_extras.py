"""Packages of the extras: too old, missing or broken ones are refused in one sentence."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from shellgs_method.commands.sim import sim
from shellgs_method.errors import SceneError
from shellgs_method.machine import extras
from shellgs_method.machine.extras import import_extra


@pytest.fixture
def installed(monkeypatch) -> dict[str, str]:
    """Versions that are installed, to be changed, where ``sim`` needs usd-core 25.8 and shapely 2."""
    versions = {"usd-core": "25.8", "shapely": "2.0.7"}

    def version(package: str) -> str:
        if package not in versions:
            raise PackageNotFoundError(package)
        return versions[package]

    needed = [
        "scipy>=1.10",
        'usd-core>=23; extra == "usd"',
        'usd-core>=25.8; extra == "sim"',
        'shapely>=2; extra == "sim"',
    ]
    monkeypatch.setattr(extras, "version", version)
    monkeypatch.setattr(extras, "requires", lambda _: needed)
    return versions


def test_a_package_that_is_too_old_is_refused_with_both_versions(installed):
    installed["usd-core"] = "24.11"
    with pytest.raises(
        SceneError, match=r"^USD needs usd-core>=25.8, but 24.11 is installed: pip install 'shellgs\[sim\]'$"
    ):
        import_extra("json", "usd-core", "sim", "USD")
    assert import_extra("json", "usd-core", "usd", "USD").loads("1") == 1


def test_a_missing_package_is_refused(installed):
    del installed["shapely"]
    with pytest.raises(
        SceneError, match=r"^a wall needs shapely>=2, which is not installed: pip install 'shellgs\[sim\]'$"
    ):
        import_extra("no_such_module", "shapely", "sim", "a wall")


def test_a_package_that_cannot_be_imported_is_not_called_missing(installed):
    with pytest.raises(SceneError, match=r"needs shapely>=2, and 2.0.7 cannot be imported \(No module named 'no_such"):
        import_extra("no_such_module", "shapely", "sim", "a wall")


def test_a_package_is_imported_where_shellgs_itself_is_not_installed(monkeypatch):
    def requires(_):
        raise PackageNotFoundError

    monkeypatch.setattr(extras, "requires", requires)
    assert import_extra("json", "numpy", "sim", "a wall").loads("1") == 1


def test_sim_checks_its_packages_before_it_begins(installed, monkeypatch):
    monkeypatch.setattr("shellgs_method.sim.trials.engine.import_extra", lambda *_: None)
    monkeypatch.setattr(extras.importlib, "import_module", lambda name: sys)
    installed |= {"xatlas": "0.0.9", "shapely": "1.8"}
    with pytest.raises(SceneError, match=r"`shellgs sim` needs shapely>=2, but 1.8 is installed"):
        sim((Path("config.yml"), Path("out")))


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib")
def test_ci_installs_the_lowest_version_of_each_package_of_the_extras():
    script = Path(__file__).parents[2] / ".ci" / "lowest.py"
    words = subprocess.run([sys.executable, script, "usd", "sim"], check=True, capture_output=True, text=True).stdout
    found = {each.name: str(each.specifier) for each in map(Requirement, words.split())}
    assert {"usd-core", "mujoco", "xatlas", "shapely"} == set(found)
    assert found["usd-core"] == "==26.3"
