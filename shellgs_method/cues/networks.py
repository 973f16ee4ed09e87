"""Monocular networks, loaded with their own packages."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shellgs_method.errors import SceneError, notice
from shellgs_method.machine.extras import import_extra

if TYPE_CHECKING:
    import torch

    from shellgs_method.cues.source import Prediction, Predictor
    from shellgs_method.files.photographs import View

ELSEWHERE = "or import maps made elsewhere with `shellgs mono SCENE from FOLDER`"


@dataclass(frozen=True)
class MoGe2:
    """MoGe-2 (MIT): depth and normals from one network."""

    weights: str = "Ruicheng/moge-2-vits-normal"
    """Repository on the Hugging Face hub, or a folder that holds its model.pt."""

    @property
    def command(self) -> str:
        """Command-line arguments that select this source."""
        return f"moge --weights {shlex.quote(self.weights)}"

    def load(self) -> Predictor:
        """Load the network, on the GPU if there is one.

        Raises:
            SceneError: the package or the weights are missing.
        """
        import numpy as np
        import torch

        from shellgs_method.cues.disparity import as_disparity
        from shellgs_method.cues.source import Prediction, Predictor
        from shellgs_method.files.photographs import load_photograph

        try:
            from moge.model.v2 import MoGeModel  # pyright: ignore[reportMissingImports]  # on no package index
        except ImportError as error:
            raise SceneError(
                f"MoGe-2 needs the package moge ({error}): pip install git+https://github.com/microsoft/MoGe.git, "
                f"or run Depth Anything with `shellgs mono SCENE depth-anything`, {ELSEWHERE}"
            ) from error
        weights = fetch_weights(self.weights, ["model.pt"])
        try:
            model = MoGeModel.from_pretrained(weights.folder / "model.pt").to(_device()).eval()
        except Exception as error:  # unpickling and building a model from any file may raise anything
            raise _unusable(self.weights, "MoGe-2", error) from error

        def predict(view: View) -> Prediction:
            image = torch.from_numpy(load_photograph(view).astype(np.float32) / 255).permute(2, 0, 1)
            # The focal length is known, so only the shift of the point map is estimated.
            fov_x = math.degrees(2 * math.atan(view.camera.width / (2 * float(view.camera.K[0, 0]))))
            maps = model.infer(image.to(_device()), fov_x=fov_x, use_fp16=_device().type == "cuda")
            depth = maps["depth"].cpu().numpy()  # infinite outside the network's own mask
            normal = maps["normal"].cpu().numpy() if "normal" in maps else None
            return Prediction(as_disparity(depth, "depth"), normal)

        return Predictor(self.weights, weights.revision, predict, weights.licence)


@dataclass(frozen=True)
class DepthAnything:
    """Depth Anything V2: disparity; normals are computed from the aligned depth.

    The weights of Small are Apache-2.0; those of Base and Large are for non-commercial use only (CC-BY-NC-4.0).
    """

    weights: str = "depth-anything/Depth-Anything-V2-Small-hf"
    """Repository on the Hugging Face hub, or a folder in the format of transformers."""

    @property
    def command(self) -> str:
        """Command-line arguments that select this source."""
        return f"depth-anything --weights {shlex.quote(self.weights)}"

    def load(self) -> Predictor:
        """Load the network, on the GPU if there is one.

        Raises:
            SceneError: the package or the weights are missing.
        """
        import torch

        from shellgs_method.cues.disparity import as_disparity
        from shellgs_method.cues.source import Prediction, Predictor
        from shellgs_method.files.photographs import load_photograph

        try:
            transformers = import_extra("transformers", "transformers", "mono", "Depth Anything")
        except SceneError as error:
            raise SceneError(f"{error}, {ELSEWHERE}") from error
        weights = fetch_weights(self.weights, ["*.json", "*.safetensors"])
        try:
            processor = transformers.AutoImageProcessor.from_pretrained(weights.folder)
            model = transformers.DepthAnythingForDepthEstimation.from_pretrained(weights.folder).eval()
        except Exception as error:  # reading any configuration may raise anything
            raise _unusable(self.weights, "Depth Anything", error) from error
        torch.nn.Module.to(model, _device())
        meaning = "depth" if model.config.depth_estimation_type == "metric" else "disparity"

        @torch.inference_mode()
        def predict(view: View) -> Prediction:
            inputs = processor(images=load_photograph(view), return_tensors="pt").to(_device())
            size = (view.camera.height, view.camera.width)
            (maps,) = processor.post_process_depth_estimation(model(**inputs), target_sizes=[size])
            return Prediction(as_disparity(maps["predicted_depth"].float().cpu().numpy(), meaning))

        return Predictor(self.weights, weights.revision, predict, weights.licence)


@dataclass(frozen=True)
class Weights:
    """Local files of a network's weights."""

    folder: Path
    revision: str
    licence: str


def fetch_weights(name: str, patterns: list[str]) -> Weights:
    """Use a local folder of weights, or download a hub repository once into the hub's cache.

    Raises:
        SceneError: the folder does not exist and the repository cannot be downloaded.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    from shellgs_method.cues.source import hash_of

    folder = Path(name)
    if folder.is_dir():
        files = sorted(path for pattern in patterns for path in folder.glob(pattern))
        if not files:
            raise SceneError(f"{folder} holds no weights: it has no {', '.join(patterns)}")
        return Weights(folder, hash_of([(path.name, path) for path in files]), _licence(folder))
    try:
        # In the hub's cache, a snapshot's folder is named by its commit.
        folder = Path(snapshot_download(name, allow_patterns=[*patterns, "README.md"]))
    except (OSError, HFValidationError) as error:
        raise SceneError(
            f"the weights {name} cannot be downloaded ({_first_sentence(error)}): check the name and the network, give "
            f"a local folder with --weights, {ELSEWHERE}"
        ) from error
    return Weights(folder, folder.name, _licence(folder))


def _licence(folder: Path) -> str:
    """The licence stated in the header of the model card."""
    from huggingface_hub import ModelCard

    unknown = "not stated"
    if not (folder / "README.md").is_file():
        return unknown
    try:
        data = ModelCard.load(folder / "README.md").data
    except ValueError as error:
        notice(f"the model card in {folder} cannot be read: {error}")
        return unknown
    name = data.get("license_name") if data.get("license") == "other" else data.get("license")
    return str(name or unknown).lower()


def _device() -> torch.device:
    import torch

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _unusable(weights: str, network: str, error: Exception) -> SceneError:
    return SceneError(f"{weights} cannot be loaded as weights of {network} ({_first_sentence(error)})")


def _first_sentence(error: Exception) -> str:
    """First sentence of a library's error message, without its advice."""
    lines = str(error).strip().splitlines()
    return lines[0].split(". ")[0].rstrip(".") if lines else type(error).__name__
