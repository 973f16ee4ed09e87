"""Sources of monocular cues: a network, or existing maps."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from shellgs_method.cues.normals import Convention
from shellgs_method.files.atomic import content_hash
from shellgs_method.files.photographs import View


@dataclass(frozen=True)
class Prediction:
    """Predicted maps of one view, at the size of its camera.

    Attributes:
        disparity: disparity, larger where nearer, affine in the inverse depth; NaN where unknown.
        normal: normals in the OpenCV camera frame, of either sign and any length, zero where unknown; None to use
            those of the depth's gradient.
        otherwise: disparity if the values meant something else, by what they meant; empty where it is known.
    """

    disparity: Float32[np.ndarray, "H W"]
    normal: Float[np.ndarray, "H W 3"] | None = None
    otherwise: Mapping[str, Float32[np.ndarray, "H W"]] = field(default_factory=dict)


@dataclass(frozen=True)
class Predictor:
    """A prediction function, and where its predictions come from.

    Attributes:
        name: name of the network's weights, or the folder of maps.
        revision: commit of the weights on the hub, or a hash of the local files.
        predict: function from a view to its prediction; None if there is none.
        licence: licence of the weights, as stated in their model card; None for existing maps.
        convention: declared axes of the normals, to be checked; None if they are known.
        values: declared meaning of the values, to be checked; None if it is known.
    """

    name: str
    revision: str
    predict: Callable[[View], Prediction | None]
    licence: str | None = None
    convention: Convention | None = None
    values: str | None = None

    @property
    def non_commercial(self) -> bool:
        """Whether the licence forbids commercial use, as CC-BY-NC-4.0 does."""
        return self.licence is not None and ("nc" in self.licence.split("-") or "non-commercial" in self.licence)


def hash_of(files: Sequence[tuple[str, Path]], *words: str) -> str:
    """SHA-256 of words and files, including the files' names, which come before each."""
    digest = hashlib.sha256("\0".join(words).encode())
    for name, path in files:
        digest.update(b"\0" + os.fsencode(name) + b"\0" + content_hash(path).encode())
    return digest.hexdigest()
