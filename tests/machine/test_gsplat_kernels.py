"""What is said of gsplat's kernels, with tools that are not here."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

from shellgs_method.errors import SceneError
from shellgs_method.machine import doctor, gsplat_kernels, system
from shellgs_method.runs import limits


@pytest.fixture
def tools(tmp_path, monkeypatch) -> Path:
    """A folder that alone is the PATH, of a machine with torch for CUDA 13.0, a C++ compiler and ninja."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr("torch.utils.cpp_extension.CUDA_HOME", None)
    monkeypatch.setattr(system, "compiler", lambda: "g++")
    monkeypatch.setattr("torch.utils.cpp_extension.is_ninja_available", lambda: True)
    return folder


@pytest.fixture
def on_cuda(tmp_path, monkeypatch) -> Iterator[Path]:
    """A GPU, and no compiled kernels in the folder where torch keeps them."""
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    gsplat_kernels.kernels_fault.cache_clear()
    yield tmp_path / "kept"
    gsplat_kernels.kernels_fault.cache_clear()


def add_nvcc(tools: Path, release: str, refusal: str = "") -> None:
    nvcc = tools / "nvcc"
    refused = f'echo "{refusal}" >&2; exit 1' if refusal else "exit 0"
    nvcc.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo "release {release}, V"; exit 0; fi\n{refused}\n')
    nvcc.chmod(0o755)


def test_a_machine_with_all_tools_lacks_nothing(tools):
    add_nvcc(tools, "13.2")  # of another minor version
    assert gsplat_kernels.lacking_to_compile() == []


def test_a_toolkit_that_is_not_on_the_path_is_put_there(tools, monkeypatch):
    home = tools.parent / "cuda"
    (home / "bin").mkdir(parents=True)
    add_nvcc(home / "bin", "13.0")
    assert gsplat_kernels.lacking_to_compile() == ["there is no nvcc on the PATH: install CUDA's toolkit 13.0"]
    monkeypatch.setattr("torch.utils.cpp_extension.CUDA_HOME", str(home))
    assert gsplat_kernels.lacking_to_compile() == []
    assert shutil.which("nvcc") == str(home / "bin" / "nvcc")


def test_what_is_missing_to_compile_is_named_with_its_remedy(tools, monkeypatch):
    assert gsplat_kernels.lacking_to_compile() == ["there is no nvcc on the PATH: install CUDA's toolkit 13.0"]
    add_nvcc(tools, "12.4")
    assert gsplat_kernels.lacking_to_compile() == ["nvcc is of CUDA 12.4, and torch of 13.0: install the toolkit 13.0"]
    add_nvcc(tools, "13.0", refusal="host_config.h:143: error: unsupported GNU version")
    (refused,) = gsplat_kernels.lacking_to_compile()
    assert "nvcc refuses the C++ compiler (host_config.h:143: error: unsupported GNU version)" in refused
    add_nvcc(tools, "13.0")
    monkeypatch.setattr(system, "compiler", lambda: None)
    monkeypatch.setattr("torch.utils.cpp_extension.is_ninja_available", lambda: False)
    compiler, ninja = gsplat_kernels.lacking_to_compile()
    assert "g++" in compiler
    assert "pip install ninja" in ninja


def test_the_doctor_says_how_long_the_first_run_compiles_and_compiles_nothing(tools, on_cuda, monkeypatch):
    add_nvcc(tools, "13.0")
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)  # its import would compile
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    finding = doctor._gsplat()
    assert finding.works
    assert "about 35 minutes on 2 cores" in finding.detail
    assert str(on_cuda) in finding.detail


@pytest.mark.parametrize(("jobs", "cores"), [("", 10), ("4", 4), ("0", 64), ("all", 64)])
def test_jobs_that_are_no_number_are_all_cores(on_cuda, monkeypatch, jobs, cores):
    monkeypatch.setenv("MAX_JOBS", jobs)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    assert f"on {cores} cores" in gsplat_kernels.compiling()


def test_the_doctor_says_why_kernels_do_not_load(tools, on_cuda, monkeypatch):
    assert "there is no nvcc on the PATH" in doctor._gsplat().detail
    compiled = gsplat_kernels.kept_in() / "gsplat_cuda.so"
    compiled.touch()
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    finding = doctor._gsplat()
    assert not finding.works
    assert not finding.needed
    assert "neither load nor compile" in finding.detail
    assert gsplat_kernels.TORCH_COSTS in finding.detail


def test_a_first_run_says_before_it_compiles_how_long_it_takes(tools, on_cuda, monkeypatch, caplog):
    add_nvcc(tools, "13.0")
    module = ModuleType("gsplat.cuda._backend")
    module._C = object()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", module)
    assert gsplat_kernels.kernels_fault() is None
    (record,) = caplog.records
    assert "compiled now, once: about" in record.getMessage()
    assert str(on_cuda) in record.getMessage()


def test_runs_that_begin_at_once_compile_one_after_the_other(tools, on_cuda, monkeypatch):
    """Gsplat removes the folder in which another run is compiling."""
    compiling, found = threading.Lock(), []

    def load(_: str) -> SimpleNamespace:
        found.append(compiling.acquire(blocking=False))
        time.sleep(0.5)
        compiling.release()
        return SimpleNamespace(_C=object())

    monkeypatch.setattr(gsplat_kernels, "importlib", SimpleNamespace(import_module=load))
    runs = [threading.Thread(target=gsplat_kernels.kernels_fault) for _ in range(3)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert found == [True, True, True]


def test_training_with_gsplat_alone_is_refused_where_it_cannot_run(monkeypatch):
    from method_configs import photo_gs

    config = photo_gs.config
    monkeypatch.setattr(config.pipeline.model, "backend", "gsplat")
    monkeypatch.setattr(config.machine, "device_type", "cpu")
    with pytest.raises(
        SceneError, match=r"backend cannot be gsplat here: its kernels need a CUDA device.*leave it out"
    ):
        limits._check_backend(config)
    monkeypatch.setattr(config.machine, "device_type", "cuda")
    monkeypatch.setattr(limits, "kernels_fault", lambda: "there is no nvcc")
    with pytest.raises(SceneError, match="there is no nvcc"):
        limits._check_backend(config)
    monkeypatch.setattr(limits, "kernels_fault", lambda: None)
    limits._check_backend(config)
