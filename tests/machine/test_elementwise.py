"""Loops in C++ against autograd in torch, and compiling them."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from layouts import LAYOUTS
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException, SetTrace

from shellgs_method.errors import SceneError
from shellgs_method.machine import cpp, system
from shellgs_method.machine.elementwise import dot, elementwise
from shellgs_method.machine.symbols import Symbol

UNARY: dict[str, Callable] = {
    "arithmetic": lambda x: 2 - 3 * x / (1 + x * x) + 1 / (x * x + 2) - -x,
    "detach": lambda x: x * x.detach(),
    "where": lambda x: torch.where((x > -0.3) & (x <= 0.8), x * x, 2.0),
    "relu and abs": lambda x: torch.relu(x) + 3 * torch.abs(x - 0.1),
    "least and greatest": lambda x: torch.minimum(x, 0.1 - x) * torch.maximum(2 * x, x * x),
    "clamp": lambda x: torch.clamp_min(x, 0.2) * x,
    "root and logarithms": lambda x: torch.sqrt(x * x + 1) * torch.log(x * x + 2) + torch.log2(x * x + 3),
    "rounding": lambda x: x * torch.floor(3 * x) + torch.ceil(2 * x),
    "infinity": lambda x: torch.where(x > 0, x, 1 / torch.where(x > 0, 1.0, -math.inf)),
}


@pytest.mark.parametrize("name", UNARY)
def test_each_operation_and_its_derivative_are_those_of_torch(compiler, name):
    def function(vector):
        return [[UNARY[name](x) for x in vector]]

    x = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    (found,) = elementwise(function, x)
    (exact := x.detach().double().requires_grad_())
    # torch's where, minimum and maximum take no mixture of tensors and numbers of two kinds
    expected = torch.stack([UNARY[name](each) for each in exact.unbind(1)], dim=1)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)
    weights = torch.linspace(-1, 1, 150).view(50, 3)
    (gradient,) = torch.autograd.grad((found * weights).sum(), x)
    (reference,) = torch.autograd.grad((expected * weights).sum(), exact)
    torch.testing.assert_close(gradient.double(), reference, rtol=1e-5, atol=1e-5)


def mixed(a, b, scale):
    """Two outputs of three inputs."""
    return [[scale[0] * dot(a, b)], [x * y * scale[0] for x, y in zip(a, b, strict=True)]]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [(3, 16), (2, 17), (4, 45), (5, 7)])
def test_inputs_of_every_layout_and_size_are_read_and_get_their_gradients(compiler, monkeypatch, layout, size):
    random = torch.Generator().manual_seed(1)
    a, b = (torch.randn(*size, 3, generator=random, requires_grad=True) for _ in range(2))
    scale = torch.tensor([1.5])
    found = []
    for compiled in ("1", "0"):
        monkeypatch.setenv("SHELLGS_COMPILE", compiled)
        total, products = elementwise(mixed, LAYOUTS[layout](a), b, scale)
        output = (total.square() * torch.arange(size[1])[:, None]).sum() + products[..., 1].sum()
        found.append((total, products, *torch.autograd.grad(output, [a, b])))
    for compiled, plain in zip(*found, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-5, atol=1e-5)


def test_an_output_without_a_gradient_costs_none(compiler):
    a, b = torch.randn(2, 20, 3, requires_grad=True).unbind(0)
    total, _ = elementwise(mixed, a, b, torch.ones(1))
    torch.testing.assert_close(torch.autograd.grad(total.sum(), a)[0], b)


def test_what_is_not_a_number_stays_so(compiler):
    def function(x):
        return [[torch.relu(x[0]), torch.abs(x[0]), torch.clamp_min(x[0], 1.0), torch.sqrt(x[0]) + torch.log(x[0])]]

    assert elementwise(function, torch.full((20, 1), math.nan))[0].isnan().all()


def test_no_elements_are_no_error(compiler):
    total, products = elementwise(mixed, torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(1))
    assert total.shape == (0, 1)
    assert products.shape == (0, 3)


def test_what_cannot_be_written_in_cpp_is_an_error_not_a_wrong_result():
    with pytest.raises((KeyError, TypeError, AttributeError)):
        torch.sin(Symbol("x"))  # pyright: ignore[reportArgumentType]


COMPILE = """
from shellgs_method.machine.cpp import load_library
print(load_library('extern "C" int seven() {{ return {}; }}\\n').seven())
"""


def test_of_two_processes_one_compiles_and_the_other_waits(compiler, tmp_path, monkeypatch):
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    command = [sys.executable, "-c", COMPILE.format(7)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [process.communicate()[0] for process in both]
    assert all(output.endswith("7\n") for output in outputs)
    assert sum(output.count("Compiling kernel") for output in outputs) == 1
    assert "Compiling" not in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_a_folder_that_cannot_be_written_is_said_and_compiles_nothing(compiler, tmp_path, monkeypatch, caplog):
    (file := tmp_path / "file").write_text("")
    monkeypatch.setenv("SHELLGS_CACHE", str(file))
    assert cpp.load_library('extern "C" int eight() { return 8; }\n') is None
    (record,) = caplog.records
    assert str(file) in record.getMessage()


def test_without_a_compiler_torch_serves_and_says_so(monkeypatch, caplog):
    monkeypatch.delenv("SHELLGS_COMPILE", raising=False)
    monkeypatch.setenv("CXX", "no-such-compiler")
    cpp.compiler_works.cache_clear()
    cpp.load_library.cache_clear()
    total, _ = elementwise(mixed, torch.ones(20, 3), torch.ones(20, 3), torch.ones(1))
    cpp.compiler_works.cache_clear()
    cpp.load_library.cache_clear()
    assert total.unique() == 3
    (record,) = caplog.records
    assert "no C++ compiler" in record.getMessage()


@pytest.mark.parametrize("left", [0, 0.5, 0.99, None], ids=["empty", "half", "cut off", "one byte changed"])
def test_a_damaged_library_is_made_again(compiler, tmp_path, monkeypatch, left):
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path / "a folder"))
    command = [sys.executable, "-c", COMPILE.format(6)]
    subprocess.run(command, check=True, capture_output=True)
    (library,) = (tmp_path / "a folder").glob("*.so")
    whole = library.read_bytes()
    damaged = whole[:-1] + bytes([whole[-1] ^ 1]) if left is None else whole[: int(left * len(whole))]
    library.write_bytes(damaged)
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout.endswith("6\n")


@pytest.mark.parametrize(("said", "meant"), [("off", False), ("No", False), ("false", False), ("", True), ("ON", True)])
def test_compiling_is_switched_by_any_usual_word(compiler, monkeypatch, said, meant):
    monkeypatch.setenv("SHELLGS_COMPILE", said)
    assert cpp.compiles() == meant


def test_an_unknown_word_for_compiling_is_refused(monkeypatch):
    monkeypatch.setenv("SHELLGS_COMPILE", "nope")
    with pytest.raises(SceneError, match="SHELLGS_COMPILE is 'nope': set it to 0"):
        cpp.compiles()


def test_a_compiler_may_have_arguments(compiler, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", f"{system.compiler()} -O1")
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    library = cpp.load_library('extern "C" int five() { return 5; }\n')
    assert library is not None
    assert library.five() == 5


def test_where_the_derivative_cannot_be_compiled_torch_serves(compiler, monkeypatch):
    def function(x, scale):
        return [[scale[0] * each * each for each in x], [x[0]]]

    x, scale = torch.randn(20, 3, requires_grad=True), torch.tensor([2.0])
    squares, _ = elementwise(function, x, scale)
    monkeypatch.setattr(cpp, "load_library", lambda _: None)
    torch.testing.assert_close(torch.autograd.grad(squares.sum(), x)[0], 4 * x)


def test_the_viewers_interrupt_while_a_kernel_compiles_passes_through_and_it_compiles_later(
    compiler, tmp_path, monkeypatch
):
    viewer = RenderStateMachine.__new__(RenderStateMachine)
    viewer.interrupt_render_flag = True
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    source = 'extern "C" int nine() { return 9; }\n'
    with pytest.raises(IOChangeException), SetTrace(viewer.check_interrupt):
        cpp.load_library(source)
    library = cpp.load_library(source)
    assert library is not None
    assert library.nine() == 9
