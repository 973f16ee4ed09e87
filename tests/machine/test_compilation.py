"""Compiled kernels: what ends compiling, and what only passes through."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable

import pytest
import torch
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException, SetTrace
from torch import Tensor
from torch._inductor import cpp_builder
from torch._inductor.exc import InvalidCxxCompiler

from shellgs_method.machine import compilation
from shellgs_method.machine.compilation import run_fused
from shellgs_method.render.rasterizer import gsplat_backend

COMPILED, PLAIN = 10.0, 1.0


def add_chunk(total: Tensor, chunk: Tensor) -> Tensor:
    """Add a chunk in place, as the compositing kernels do; says whether it is compiled."""
    total.copy_(total + chunk)
    return chunk * (COMPILED if torch.compiler.is_compiling() else PLAIN)


def uncompilable(total: Tensor, chunk: Tensor) -> Tensor:
    total.copy_(total + chunk)
    return chunk * PLAIN if chunk.sum() > 0 else chunk  # a branch on data


def run(kernel: Callable[..., Tensor] = add_chunk, n: int = 5) -> tuple[float, float]:
    """How often the chunk was added, and :data:`COMPILED` or :data:`PLAIN`."""
    total = torch.zeros(n, 3)
    kind = run_fused(kernel, total, torch.ones(n, 3))
    return float(total.unique()), float(kind.unique())


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


@pytest.fixture
def viewer() -> RenderStateMachine:
    """What interrupts a render of the viewer once its flag is set."""
    machine = RenderStateMachine.__new__(RenderStateMachine)
    machine.interrupt_render_flag = False
    return machine


@pytest.fixture(autouse=True)
def nothing_compiled(compiler, monkeypatch):
    compilation._compiled.cache_clear()


def test_the_viewers_interrupt_while_a_kernel_compiles_passes_through_and_the_kernel_is_compiled(viewer, monkeypatch):
    compile_kernel = torch.compile

    def move_camera(*args, **options):
        viewer.interrupt_render_flag = True
        return compile_kernel(*args, **options)

    monkeypatch.setattr(torch, "compile", move_camera)
    with pytest.raises(IOChangeException), SetTrace(viewer.check_interrupt):
        run()
    assert run(n=6) == (1, COMPILED)
    assert not compilation._failed


def test_an_interrupt_at_any_line_of_a_call_passes_through_and_adds_no_chunk_twice():
    run()
    total, chunk = torch.zeros(5, 3), torch.ones(5, 3)
    before, interrupted, last = 0.0, True, 0
    while interrupted:
        last += 1
        lines = iter(range(last))

        def hook(frame, event, arg, lines=lines):
            if event == "line" and next(lines, None) is None:
                raise IOChangeException
            return hook

        try:
            with SetTrace(hook):
                run_fused(add_chunk, total, chunk)
            interrupted = False
        except IOChangeException:
            pass
        added = float(total.unique()) - before
        before += added
        assert added in (0, 1)
    assert last > 20
    assert added == 1
    assert run() == (1, COMPILED)


def test_a_trace_hook_goes_on_after_a_compiled_call():
    seen = []

    def hook(frame, event, arg):
        seen.append(frame.f_code.co_name)
        return hook

    sys.settrace(hook)
    try:
        run()
        assert sys.gettrace() is hook
    finally:
        sys.settrace(None)
    assert seen.count("run") > 2
    assert len(seen) < 1000  # not the compiler's


def test_ctrl_c_while_a_kernel_compiles_ends_the_program_not_the_compiling(monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(torch, "compile", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run()
    assert run() == (1, COMPILED)


def test_an_error_of_a_running_kernel_passes_through_and_the_kernel_is_not_run_again(monkeypatch):
    total, chunk = torch.zeros(5, 3), torch.ones(5, 3)

    def out_of_memory(kernel, **_):
        def run(total: Tensor, chunk: Tensor) -> Tensor:
            kernel(total, chunk)
            raise RuntimeError("not enough memory")

        return run

    with monkeypatch.context() as patch:
        patch.setattr(torch, "compile", out_of_memory)
        with pytest.raises(RuntimeError, match="not enough memory"):
            run_fused(add_chunk, total, chunk)
    assert total.unique() == 1
    assert run() == (1, COMPILED)


def test_a_kernel_that_does_not_compile_leaves_the_others_compiled(caplog):
    assert run(uncompilable) == (1, PLAIN)
    assert run() == (1, COMPILED)
    assert run(uncompilable) == (1, PLAIN)
    assert compilation._failed == {"test_compilation.uncompilable"}
    (warning,) = warnings_of(caplog)
    assert warning.startswith("Some kernels of rasterizer or losses run without torch.compile, slower: Unsupported")


def test_without_a_compiler_no_kernel_tries_to_compile(monkeypatch, caplog):
    def none() -> str:
        raise InvalidCxxCompiler

    compilation._compiler_works.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(cpp_builder, "get_cpp_compiler", none)
        patch.setattr(torch, "compile", None)
        assert run() == run() == (1, PLAIN)
    compilation._compiler_works.cache_clear()
    (warning,) = warnings_of(caplog)
    assert "No working C++ compiler" in warning


def test_kernels_serve_any_number_of_threads(compiler):
    """Dynamo guards the number of threads, and gives up on the ninth."""
    before = torch.get_num_threads()
    try:
        run()
        with torch._dynamo.config.patch(error_on_recompile=compilation._chooses_guards()):
            for threads in range(1, 11):
                torch.set_num_threads(threads)
                assert run() == (1, COMPILED)
    finally:
        torch.set_num_threads(before)


def test_an_interrupt_while_gsplats_kernels_load_is_no_fault_of_theirs(viewer, monkeypatch):
    def move_camera(name: str):
        viewer.interrupt_render_flag = True
        return type("Module", (), {"_C": name})

    gsplat_backend._kernels_fault.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(importlib, "import_module", move_camera)
        with pytest.raises(IOChangeException), SetTrace(viewer.check_interrupt):
            str(gsplat_backend._kernels_fault())
        assert gsplat_backend._kernels_fault() is None
    gsplat_backend._kernels_fault.cache_clear()
