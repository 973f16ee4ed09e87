"""In training, photographs of little light count as those of day do."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_runs import data_of, model_of, trainer_of

from shellgs_method.files.transfer import DARK
from shellgs_method.losses.photometric import PhotometricLoss


def repaint(scene: Path, paint: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace all photographs of a scene."""
    for path in (scene / "images").iterdir():
        with Image.open(path) as photograph:
            image = paint(np.asarray(photograph.convert("RGB")).astype(float))
        Image.fromarray(image.round().astype(np.uint8)).save(path)


def half_black(image: np.ndarray) -> np.ndarray:
    """The image with a black border, as around an object that was cut out."""
    image[:, : image.shape[1] // 2] = 0
    return image


def test_by_day_photographs_are_compared_as_they_are(pristine_scene: Path, tmp_path: Path):
    model = model_of(trainer_of(pristine_scene, tmp_path, "photo_gs"))
    assert model.objective.light == 1
    image = torch.rand(4, 4, 3)
    assert model.objective.as_by_day(image) is image


def test_by_day_what_is_black_says_nothing_of_the_light(scene: Path, tmp_path: Path):
    repaint(scene, half_black)
    assert data_of(trainer_of(scene, tmp_path, "photo_gs")).light == 1


@pytest.mark.parametrize("mask", [False, True])
def test_dark_photographs_are_compared_as_bright_as_by_day(scene: Path, tmp_path: Path, mask: bool):
    repaint(scene, lambda image: 0.2 * image)
    if mask:  # what it leaves out is brighter
        white = np.zeros((32, 48), bool)
        white[:, :30] = True
        repaint(scene, lambda image: np.where(white[..., None], 255, image))
        (scene / "masks").mkdir()
        for path in (scene / "images").iterdir():
            Image.fromarray(np.where(white, 0, 255).astype(np.uint8)).save(scene / "masks" / path.name)
    trainer = trainer_of(scene, tmp_path, "photo_gs")
    model, batch = model_of(trainer), data_of(trainer).cached_train[0]
    photograph = batch["image"].float() / 255
    shown = photograph[:, 30:] if mask else photograph
    light = model.objective.light
    assert light * 255 * shown.mean(dim=-1).median() == pytest.approx(DARK, rel=0.1)

    rgb = photograph + 0.1 * torch.rand(photograph.shape)
    view = model._view(batch)
    loss = model.objective(view, rgb, None, 0.5)["photometric"]
    assert loss == pytest.approx(PhotometricLoss(light * photograph, batch.get("mask"))(light * rgb).item(), rel=1e-5)
    model.log_every = 1
    psnr = model.get_metrics_dict({"rgb": rgb}, batch)["psnr"]
    error = (rgb - photograph).square()[:, 30:] if mask else (rgb - photograph).square()
    assert psnr == pytest.approx(-10 * error.mean().log10().item(), abs=1e-3)
