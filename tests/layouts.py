"""Layouts in memory of a tensor of elements in two dimensions, by their names."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "contiguous": lambda x: x,
    "transposed": lambda x: x.transpose(0, 1).contiguous().transpose(0, 1),
    "shifted": lambda x: torch.nn.functional.pad(x, (0, 0, 2, 3, 1, 1))[1:-1, 2:-3],
    "coordinates apart": lambda x: x.permute(2, 0, 1).contiguous().permute(1, 2, 0),
    "one for all rows": lambda x: x[:1],
    "one for all columns": lambda x: x[:, :1],
    "one for all": lambda x: x[0, 0],
}
