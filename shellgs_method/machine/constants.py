"""Small tensors of known values, kept: to bring one to a GPU, the host waits for the GPU."""

from __future__ import annotations

import functools

import torch
from jaxtyping import Float
from torch import Tensor


def constant(*values: float, like: Tensor) -> Float[Tensor, " k"]:
    """The values in the dtype and on the device of ``like``; not to be changed."""
    return _constant(values, like.dtype, like.device)


@functools.lru_cache(maxsize=256)
@torch.inference_mode(False)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
