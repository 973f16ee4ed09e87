"""Exposure and white balance of the training photographs, learned with the run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn


class Exposures(nn.Module):
    """A gain per channel in linear light for each of V photographs.

    Their logarithms have a mean of 0 over the photographs of the whole scene whatever the parameter is, so that the
    Gaussians, and all that is exported from them, have the mean exposure: no tint can be learned that cancels.

    Args:
        num_views: number of photographs of the whole scene.
        used: indices of those that are trained on here; all if not given.
    """

    _used: Tensor

    def __init__(self, num_views: int, used: Sequence[int] | None = None):
        super().__init__()
        self.parameter = nn.Parameter(torch.zeros(num_views, 3))
        used = range(num_views) if used is None else used
        self.register_buffer("_used", torch.tensor([*used]), persistent=False)
        self.unknown = set[int]()
        """Which of the photographs used were not trained on."""

    @property
    def log_gains(self) -> Float[Tensor, "V 3"]:
        """Logarithms of the gains of the photographs used."""
        return (self.parameter - self.parameter.mean(dim=0))[self._used]

    def use(self, rows: Sequence[int | None]) -> None:
        """Use other photographs: those of some rows of the parameter, None for photographs that have no row."""
        self.unknown = {index for index, row in enumerate(rows) if row is None}
        self._used = torch.tensor([row or 0 for row in rows], device=self._used.device)

    def start(self, log_gains: Float[np.ndarray, "V 3"]) -> None:
        """Start from gains that are known."""
        self.parameter.data = torch.from_numpy(log_gains).to(self.parameter)

    @property
    def stops(self) -> Float[Tensor, "V 3"]:
        """The gains in stops."""
        return self.log_gains.detach() / math.log(2)

    @property
    def spread(self) -> Float[Tensor, ""]:
        """Standard deviation of the exposures in stops."""
        return self.stops.mean(dim=1).std(correction=0)
