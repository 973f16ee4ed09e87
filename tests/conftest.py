"""Shared fixtures: a tiny synthetic facade, a browser, and the rasterizer with and without a compiler."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

from benchmarks.gpu_kit import write_facade
from shellgs_method.errors import notice
from shellgs_method.machine import system
from shellgs_method.machine.open3d import load_libusb

load_libusb()  # for tests, and modules of nerfstudio, that import Open3D themselves
os.environ.setdefault("SHELLGS_COMPILE", "0")  # kernels take longer to compile than these tests to run


@pytest.fixture(autouse=True)
def nothing_told() -> None:
    """Each test is told what a new process would be."""
    notice.cache_clear()


@pytest.fixture(scope="session")
def pristine_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of 10 views of 48 x 32 pixels with shell and truth maps; not to be changed."""
    scene = tmp_path_factory.mktemp("facade") / "scene"
    write_facade(scene)
    return scene


@pytest.fixture
def scene(pristine_scene: Path, tmp_path: Path) -> Path:
    """A copy of the scene that a test may change."""
    return Path(shutil.copytree(pristine_scene, tmp_path / "scene"))


@pytest.fixture
def in_process(capsys, monkeypatch) -> Callable[..., str]:
    """Run a command in this process; returns its output on one line, or ``refused: `` and its message."""

    def command(name: str, *words: object) -> str:
        (entry,) = {*entry_points(group="console_scripts", name=name)}
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        try:
            entry.load()()
        except SystemExit as stop:
            if stop.code:
                return f"refused: {stop}"
        return capsys.readouterr().out.replace(" \n", " ").replace("\n", " ")

    return command


@pytest.fixture
def shellgs(in_process) -> Callable[..., str]:
    """Run `shellgs` in this process."""
    return partial(in_process, "shellgs")


@pytest.fixture
def compiler(monkeypatch) -> None:
    """Run kernels in C++; skip where there is no compiler."""
    if system.compiler() is None:
        pytest.skip("no C++ compiler")
    monkeypatch.delenv("SHELLGS_COMPILE", raising=False)


@pytest.fixture
def offline_wandb(monkeypatch) -> Iterator[None]:
    """Weights & Biases without an account, a network or terminal output."""
    for name, value in {"MODE": "offline", "SILENT": "true", "CONSOLE": "off"}.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    import wandb  # slow

    yield
    wandb.teardown()


@pytest.fixture
def browser() -> Iterator[Any]:
    """Headless Chromium, with WebGL in software."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        names = ("chromium", "chromium-browser", "google-chrome")
        found = own if Path(own).is_file() else next(filter(None, map(shutil.which, names)), None)
        if found is None:
            pytest.skip("there is no Chromium")
        software = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=found, args=software)
        yield browser
        browser.close()
