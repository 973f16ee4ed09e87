"""CUDA kernels that are written at run time: compiled by NVRTC into cubins that are kept on disk, and launched.

NVRTC comes with PyTorch's packages and needs neither nvcc nor a C++ compiler.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from shellgs_method.errors import notice
from shellgs_method.machine import cpp
from shellgs_method.machine.cache import cache_folder, compiled

THREADS = 256
"""Threads of a block."""
_FLAGS = ("--std=c++17", "--device-as-default-execution-space")
_INVALID_CONTEXT = 201


class Kernel:
    """A kernel ``run``, one thread per element, on one device; its only parameter is a structure of 64-bit words.

    Raises:
        OSError: the driver does not load it.
    """

    def __init__(self, cubin: Path, device: int):
        self._device, self._context, module, self._run = device, *(ctypes.c_void_p() for _ in range(3))
        driver = _driver()
        handle = ctypes.c_int()
        _check(driver.cuDeviceGet(ctypes.byref(handle), device))
        _check(driver.cuDevicePrimaryCtxRetain(ctypes.byref(self._context), handle))
        with torch.cuda.device(device):
            _check(driver.cuCtxSetCurrent(self._context))
            _check(driver.cuModuleLoadData(ctypes.byref(module), cubin.read_bytes()))
            _check(driver.cuModuleGetFunction(ctypes.byref(self._run), module, b"run"))
        self._launch = driver.cuLaunchKernel

    def __call__(self, elements: int, arguments: ctypes.Array) -> None:
        """Queue it on the current stream of the device."""
        if torch.cuda.current_device() != self._device:
            with torch.cuda.device(self._device):
                return self(elements, arguments)
        blocks, stream = -(-elements // THREADS), torch._C._cuda_getCurrentRawStream(self._device)
        parameters = ctypes.byref(ctypes.c_void_p(ctypes.addressof(arguments)))
        status = self._launch(self._run, blocks, 1, 1, THREADS, 1, 1, 0, stream, parameters, None)
        if status == _INVALID_CONTEXT:  # autograd's thread, before any other launch there
            _check(_driver().cuCtxSetCurrent(self._context))
            status = self._launch(self._run, blocks, 1, 1, THREADS, 1, 1, 0, stream, parameters, None)
        return _check(status)


def compiles(device: int) -> bool:
    """Whether kernels can be compiled and loaded for a device, and compiling is not switched off."""
    return cpp.switched_on() and _works(device)


@functools.cache
def _works(device: int) -> bool:
    return load_kernel('extern "C" __global__ void run() {}\n', device) is not None


@functools.cache
def load_kernel(source: str, device: int) -> Kernel | None:
    """Compile CUDA, unless that was done on this machine before, and load it; None, and a report, if that fails."""
    try:
        arch = "sm_{}{}".format(*torch.cuda.get_device_capability(device))
        made_of = [source, arch, *_FLAGS, str(torch.version.cuda)]
        return Kernel(compiled(made_of, ".cubin", lambda made: made.write_bytes(compile_cubin(source, arch))), device)
    except OSError as error:
        notice(
            f"Some or all of projections and losses run without CUDA kernels of their own, several times slower: "
            f"{error}. They are kept in {cache_folder()}; the environment variable SHELLGS_CACHE names another folder."
        )
        return None


def compile_cubin(source: str, arch: str) -> bytes:
    """Compile CUDA for an architecture such as sm_90.

    Raises:
        OSError: there is no NVRTC, or it refuses the source or the architecture.
    """
    nvrtc = _nvrtc()
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"kernel.cu", 0, None, None)
    try:
        options = [each.encode() for each in (f"--gpu-architecture={arch}", *_FLAGS)]
        if status := nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options)):
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            lines = log.value.decode(errors="replace").splitlines()
            raise OSError(f"NVRTC fails ({next((x for x in lines if 'error' in x), f'status {status}')})")
        nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
        cubin = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetCUBIN(program, cubin)
        return cubin.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


@functools.cache
def _nvrtc() -> ctypes.CDLL:
    """NVRTC of PyTorch's version of CUDA."""
    for path in _places():
        try:
            return ctypes.CDLL(str(path))
        except OSError:
            continue
    raise FileNotFoundError(f"there is no NVRTC of CUDA {torch.version.cuda} (pip install nvidia-cuda-nvrtc)")


def _places() -> Iterator[str | Path]:
    """Where NVRTC may be: loaded or known to the system, in pip's packages, in an installed CUDA."""
    major = int((torch.version.cuda or "0").split(".")[0])
    minor = 2 if major == 11 else 0  # of the interface: all of CUDA 11 from 11.2 on have that number
    windows = sys.platform == "win32"
    name = f"nvrtc64_{major}{minor}_0.dll" if windows else f"libnvrtc.so.{major}" + f".{minor}" * (major == 11)
    yield name
    packages = [Path(torch.__file__).parents[1], *map(Path, sys.path)]
    toolkits = [os.environ[each] for each in ("CUDA_HOME", "CUDA_PATH") if os.environ.get(each)] + ["/usr/local/cuda"]
    folders = ("bin", "bin/x64") if windows else ("lib64", "lib", "targets/*/lib")
    for pattern in ("torch/lib", *(f"nvidia/*/{each}" for each in ("lib", "bin", "bin/*"))):
        for root in packages:
            yield from root.glob(f"{pattern}/{name}")
    for root in toolkits:
        for folder in folders:
            yield from Path(root).glob(f"{folder}/{name}")


@functools.cache
def _driver() -> ctypes.CDLL:
    driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    pointer, number = ctypes.c_void_p, ctypes.c_uint
    driver.cuLaunchKernel.argtypes = [pointer, *[number] * 7, pointer, pointer, pointer]
    return driver


def _check(status: int) -> None:
    """Raise OSError, with the driver's words, unless the status is success."""
    if status:
        words = ctypes.c_char_p()
        _driver().cuGetErrorString(status, ctypes.byref(words))
        raise OSError(f"CUDA's driver says: {(words.value or b'').decode() or f'status {status}'}")
