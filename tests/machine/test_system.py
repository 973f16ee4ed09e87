"""What the system must have is found before a download, and installed or named; libusb may come from a wheel."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from shellgs_method.machine import open3d, system

ROOT = Path(__file__).parents[2]
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="libraries of Linux")


def python(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env=os.environ | environment, cwd=ROOT, text=True, capture_output=True)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A root's machine with the libraries of the packages in this file, to which its apt-get appends its words."""
    packages = tmp_path / "packages"
    packages.write_text("\n")
    apt_get = tmp_path / "bin" / "apt-get"
    apt_get.parent.mkdir()
    apt_get.write_text(f'#!/bin/sh\necho "$*" >> {packages}\n')
    apt_get.chmod(0o755)
    monkeypatch.setenv("PATH", str(apt_get.parent), prepend=os.pathsep)
    table = {**system.LIBRARIES, system.USB: "libusb-1.0-0"}
    monkeypatch.setattr(system, "loads", lambda name: table[name] in packages.read_text().split())
    monkeypatch.setattr(system, "compiler", lambda: "/usr/bin/g++")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return packages


def test_as_root_apt_get_installs_what_is_missing_and_says_so(installed, capsys):
    installed.write_text("libx11-6 libudev1 libidn2-0 libgomp1\n")
    system.main()
    update, install = installed.read_text().splitlines()[1:]
    assert update == "-qq update"
    assert install == "-qq install -y --no-install-recommends libgl1 libegl1 libusb-1.0-0"
    assert capsys.readouterr().out == "Installing system packages with apt-get: libgl1 libegl1 libusb-1.0-0\n"


def test_without_root_one_sentence_has_the_command(installed, capsys, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    installed.write_text("libx11-6 libudev1 libidn2-0 libgomp1 libusb-1.0-0\n")
    with pytest.raises(
        SystemExit, match=r"lacks libGL\.so\.1, libEGL\.so\.1; .* sudo apt-get install -y libgl1 libegl1 "
    ):
        system.main()
    assert len(installed.read_text().splitlines()) == 1
    assert capsys.readouterr().out == ""


def test_what_apt_get_could_not_install_stops_too(installed):
    (installed.parent / "bin" / "apt-get").write_text("#!/bin/sh\nexit 100\n")
    with pytest.raises(SystemExit, match=r"lacks libGL\.so\.1.* First run: apt-get install -y libgl1 "):
        system.main()


def test_libusb_and_a_compiler_are_not_needed(installed, capsys, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(system, "compiler", lambda: None)
    installed.write_text(" ".join(system.LIBRARIES.values()))
    system.main()
    said = capsys.readouterr().out
    assert said.startswith("This system lacks a C++ compiler, libusb-1.0.so.0, and works.")
    assert "sudo apt-get install -y g++ libusb-1.0-0" in said


def test_a_python_without_venv_is_told_its_package(installed, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(system, "find_spec", lambda _: None)
    installed.write_text(" ".join(system.LIBRARIES.values()))
    with pytest.raises(SystemExit, match=rf"lacks Python's venv; .* python3\.{sys.version_info[1]}-venv"):
        system.main()


@pytest.mark.parametrize("version", [(3, 9, 2), (3, 13, 0)])
def test_a_python_that_nerfstudio_cannot_use_is_refused(monkeypatch, version):
    monkeypatch.setattr(sys, "version_info", version)
    with pytest.raises(SystemExit, match=r"this is python3\.(9|13); ShellGS needs 3\.10, 3\.11 or 3\.12"):
        system.main()


@on_linux
def test_the_check_needs_no_package():
    bare = "import ctypes, os\ndef refuse(name): raise OSError(name)\nctypes.CDLL, os.geteuid = refuse, lambda: 1000\n"
    run = "import runpy, sys\nrunpy.run_path(sys.argv[1], run_name='__main__')"
    done = python("-I", "-S", "-c", bare + run, system.__file__)
    assert done.returncode == 1
    assert done.stderr.startswith("shellgs: this system lacks libGL.so.1, ")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("target", ["demo", "test", "docs"])
def test_make_stops_before_anything_is_downloaded(tmp_path, target):
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "pyproject.toml").touch()
    fake = tmp_path / "python"
    fake.write_text('#!/bin/sh\necho "$*" >> said\nexit 1\n')
    fake.chmod(0o755)
    assert subprocess.run(["make", target, "PYTHON=./python"], cwd=tmp_path, capture_output=True).returncode == 2
    assert (tmp_path / "said").read_text() == "shellgs_method/machine/system.py\n"
    assert not (tmp_path / ".venv").exists()


@on_linux
def test_open3d_loads_with_the_libusb_of_a_wheel_where_the_system_has_none():
    code = (
        "from shellgs_method.machine import open3d, system; system.loads = lambda _: False; open3d.import_open3d();"
        "print(*{line.split()[-1] for line in open('/proc/self/maps') if 'libusb' in line})"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert [Path(path).parts[-2:] for path in done.stdout.split()] == [("libusb_package", "libusb-1.0.so")]


@on_linux
def test_a_command_that_cannot_load_open3d_ends_with_one_sentence(tmp_path):
    (tmp_path / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    run = "from shellgs_method.cli import main; sys.argv[1:] = ['demo', sys.argv[1]]; main()"
    patch = "from shellgs_method.machine import system; system.loads = lambda name: name != 'libGL.so.1'; "
    done = python("-c", f"import sys; {patch}{run}", tmp_path / "demo", PYTHONPATH=f"{tmp_path}:{ROOT}")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("shellgs: Open3D cannot be loaded (libGL.so.1: cannot open shared")
    assert "apt-get install -y libgl1" in done.stderr
    assert "Traceback" not in done.stderr


def test_ctrl_c_while_open3d_is_imported_is_no_fault_of_open3d(tmp_path, monkeypatch):
    """As pybind11 raises it from the import of a module in C++."""
    (tmp_path / "open3d.py").write_text("raise ImportError('initialization failed') from KeyboardInterrupt()")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(KeyboardInterrupt):
        open3d.import_open3d()
