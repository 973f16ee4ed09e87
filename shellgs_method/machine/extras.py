"""Packages that only some commands need: import them, or say which version is needed and which is installed."""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, requires, version
from types import ModuleType

from packaging.requirements import Requirement

from shellgs_method.errors import SceneError


def import_extra(module: str, package: str, extra: str, what: str) -> ModuleType:
    """Import a module of a package of an extra, of a version that ``pyproject.toml`` allows.

    Args:
        module: name to import.
        package: name on the package index.
        extra: extra that has it.
        what: what needs it, to begin the sentence with.

    Raises:
        SceneError: the package is not installed, of another version, or cannot be imported.
    """
    needed = _needed(package, extra)
    try:
        installed = version(package)
    except PackageNotFoundError:
        installed = None
    if installed and not needed.specifier.contains(installed, prereleases=True):
        raise SceneError(f"{what} needs {needed}, but {installed} is installed: pip install 'shellgs[{extra}]'")
    try:
        return importlib.import_module(module)
    except ImportError as error:
        fault = f"and {installed} cannot be imported ({error})" if installed else "which is not installed"
        raise SceneError(f"{what} needs {needed}, {fault}: pip install 'shellgs[{extra}]'") from error


def _needed(package: str, extra: str) -> Requirement:
    """Versions of a package that an extra allows; any, where ShellGS is run without being installed."""
    try:
        given = [Requirement(line) for line in requires("shellgs") or []]
    except PackageNotFoundError:
        given = []
    found = (each for each in given if each.name == package and each.marker and each.marker.evaluate({"extra": extra}))
    return Requirement(f"{package}{next(found, Requirement(package)).specifier}")
