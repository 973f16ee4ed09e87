"""What monocular cues come from: a network that is run, or maps that were made elsewhere."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32

from dataparsers.files import content_hash
from dataparsers.photograph import View
from shellgs_method.cues.normals import Convention


@dataclass(frozen=True)
class Prediction:
    """What is claimed of one view, at the size of its camera.

    Attributes:
        disparity: larger where nearer, affine in the inverse depth; NaN where unknown.
        normal: normals in the OpenCV camera frame, of either sign and any length, zero where unknown; None to take
            those of the depth's gradient.
    """

    disparity: Float32[np.ndarray, "H W"]
    normal: Float[np.ndarray, "H W 3"] | None = None


@dataclass(frozen=True)
class Predictor:
    """Predictions for views, and what makes them.

    Attributes:
        name: of the network's weights or the folder of maps.
        revision: commit of the weights on their hub, or a hash of what is on disk.
        predict: what is claimed of a view; None where there is nothing.
        licence: of the weights, as their model card states it; None for maps that were made elsewhere.
        convention: the axes that the normals were declared to have, if they might have others.
    """

    name: str
    revision: str
    predict: Callable[[View], Prediction | None]
    licence: str | None = None
    convention: Convention | None = None

    @property
    def non_commercial(self) -> bool:
        """Whether the licence forbids commercial use, as CC-BY-NC-4.0."""
        return self.licence is not None and ("nc" in self.licence.split("-") or "non-commercial" in self.licence)


class Source(Protocol):
    """Settings of a predictor."""

    @property
    def command(self) -> str:
        """The words of the command line that choose it."""
        ...

    def load(self) -> Predictor:
        """The predictor, ready to run.

        Raises:
            SceneError: a package, the weights or the maps are missing.
        """
        ...


def hash_of(files: Sequence[Path], *words: str) -> str:
    """sha256 of some words and of files, their names included."""
    digest = hashlib.sha256("\0".join(words).encode())
    for path in files:
        digest.update(b"\0" + path.name.encode() + b"\0" + content_hash(path).encode())
    return digest.hexdigest()
