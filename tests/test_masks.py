"""User masks are found without a flag, and what they mask out is neither trained on nor measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from PIL import Image
from runs import data_of, held_out, model_of, trainer_of
from test_facade_dataparser import parse, write_colmap

from dataparsers.camera import Camera
from dataparsers.cue_maps import CueMaps
from dataparsers.errors import SceneError
from dataparsers.facade import FacadeDataParserConfig, read_views
from dataparsers.photograph import load_mask
from dataparsers.sparse_points import read_sparse_points
from shellgs_method import cli
from shellgs_method.evaluation import image, image_errors
from shellgs_method.geometry import Geometry
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell, validate
from shellgs_method.supervision import ExtraLossConfig, self_losses


def paint(path: Path, left: int, size: tuple[int, int] = (48, 32)) -> None:
    """A mask that leaves out the columns left of ``left``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full(size[::-1], 255, np.uint8)
    pixels[:, :left] = 0
    Image.fromarray(pixels).save(path)


def paint_all(scene: Path, name: str = "masks/{stem}.png") -> None:
    for photograph in sorted((scene / "images").iterdir()):
        paint(scene / name.format(stem=photograph.stem, name=photograph.name), left=12)


@pytest.mark.parametrize("name", ["masks/{stem}.png", "masks/{name}.png", "masks/images/{name}.png"])
@pytest.mark.parametrize("kind", ["transforms.json", "COLMAP"])
def test_masks_in_their_folder_are_found_without_a_flag(scene, kind, name):
    if kind == "COLMAP":
        write_colmap(scene, read_views(FacadeDataParserConfig(data=scene)), list(range(1, 11)))
    paint_all(scene, name)
    for view in [*read_views(FacadeDataParserConfig(data=scene)), *parse(scene).metadata["views"]]:
        kept = load_mask(view)
        assert kept is not None
        assert not kept[:, :12].any()
        assert kept[:, 12:].all()


def test_a_photograph_without_a_mask_is_kept_whole(scene):
    paint(scene / "masks" / "frame_00002.png", left=12)
    masks = [view.mask is not None for view in read_views(FacadeDataParserConfig(data=scene))]
    assert masks == [False, True, *[False] * 8]


def test_masks_of_no_photograph_are_refused(scene):
    paint(scene / "masks" / "elsewhere.png", left=12)
    with pytest.raises(SceneError, match=r"no photograph has a mask in .*masks/frame_00001.png.png; rename the masks"):
        read_views(FacadeDataParserConfig(data=scene))
    with pytest.raises(FileNotFoundError, match="painted is not a folder of masks"):
        read_views(FacadeDataParserConfig(data=scene, masks_path=Path("painted")))


def test_cast_leaves_masked_pixels_out_and_notices_changed_masks(scene):
    paint_all(scene)
    cli.cast(scene)
    maps, view = CueMaps.open(scene, "shell"), read_views(FacadeDataParserConfig(data=scene))[4]
    cue = maps.read(view.name, view.camera)
    assert cue is not None
    assert not cue.mask[:, :12].any()
    assert cue.mask[:, 12:].any()
    paint(scene / "masks" / "frame_00002.png", left=20)
    with pytest.raises(SceneError, match=r"masks has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


def test_align_validates_with_what_masks_keep(scene):
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh, config = load_shell(scene / alignment.shell), FacadeDataParserConfig(data=scene)
    points = read_sparse_points(config)
    before = validate(mesh, alignment, read_views(config), points)
    paint_all(scene)
    after = validate(mesh, alignment, read_views(config), points)
    for quantity in (lambda view: view.supported, lambda view: len(view.errors)):
        all_of_it, kept = (sum(map(quantity, result.views)) for result in (before, after))
        assert 0.3 * all_of_it < kept < 0.95 * all_of_it


def test_a_mask_of_another_shape_is_refused_by_its_own_name(scene):
    paint(scene / "masks" / "frame_00002.png", left=12, size=(48, 48))
    with pytest.raises(SceneError, match=r"the mask .*masks/frame_00002.png is 48x48 pixels.*is 48x32"):
        load_mask(read_views(FacadeDataParserConfig(data=scene))[1])


def test_masked_pixels_are_in_no_image_metric(monkeypatch):
    """PSNR by hand; SSIM and LPIPS do not change with what is rendered there."""
    generator = torch.Generator().manual_seed(0)
    target, noise = torch.rand(40, 48, 3, generator=generator), torch.rand(40, 48, 3, generator=generator)
    kept = torch.ones(40, 48, 1, dtype=torch.bool)
    kept[:, :20] = False
    rgb = (target + 0.1 * (noise - 0.5)).clamp(0, 1)

    class Mean(torch.nn.Module):
        def forward(self, one, other):
            return (one - other).abs().mean()

    monkeypatch.setattr(image, "lpips_network", Mean)
    metrics = image_errors(rgb, target, {"on_shell": torch.ones_like(kept)}, kept)
    inside = (rgb - target)[:, 20:]
    assert metrics["psnr"] == pytest.approx(-10 * inside.square().mean().log10().item(), abs=1e-3)
    assert metrics["lpips"] == pytest.approx(inside.abs().mean().item(), rel=1e-4)
    assert metrics["psnr_on_shell"] == metrics["psnr"]
    assert image_errors(torch.where(kept, rgb, 1 - rgb), target, None, kept)["ssim"] == pytest.approx(metrics["ssim"])
    assert image_errors(rgb, target, None, torch.zeros_like(kept)) == {}


def test_masked_pixels_are_in_no_term_of_the_rendered_geometry():
    normal = torch.randn(6, 8, 3, generator=torch.Generator().manual_seed(0))
    camera = Camera(torch.eye(4), torch.tensor([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), 8, 6)
    depth, alpha, kept = torch.full((6, 8, 1), 5.0), torch.ones(6, 8, 1), torch.zeros(6, 8, 1, dtype=torch.bool)
    kept[:, 4:] = True
    extra = ExtraLossConfig(normal_consistency=1.0, normal_consistency_from=0, distortion=1.0, distortion_from=0)

    def terms(scale: float) -> dict[str, torch.Tensor]:
        changed = torch.where(kept, 1.0, scale)
        return self_losses(Geometry(depth, changed * normal, alpha, camera, changed), extra, 0.5, kept)

    assert terms(1.0).keys() == {"normal_consistency", "distortion"}
    for name, value in terms(1.0).items():
        torch.testing.assert_close(terms(7.0)[name], value)
    assert terms(1.0)["distortion"] == 1


def test_normal_consistency_can_leave_out_pixels_with_a_cue():
    normal = torch.randn(6, 8, 3, generator=torch.Generator().manual_seed(0))
    camera = Camera(torch.eye(4), torch.tensor([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), 8, 6)
    geometry = Geometry(torch.full((6, 8, 1), 5.0), normal, torch.ones(6, 8, 1), camera)
    kept, with_cue = torch.ones(6, 8, 1, dtype=torch.bool), torch.zeros(6, 8, 1, dtype=torch.bool)
    kept[0], with_cue[:, 4:] = False, True

    def term(on: Literal["everywhere", "without_cue"], with_cue: torch.Tensor | None) -> torch.Tensor:
        extra = ExtraLossConfig(normal_consistency=2.0, normal_consistency_from=0, normal_consistency_on=on)
        return self_losses(geometry, extra, 0.5, kept, with_cue)["normal_consistency"]

    each = 1 - (normal * geometry.depth_normal).sum(-1, keepdim=True)
    torch.testing.assert_close(term("everywhere", with_cue), 2 * each[kept].mean())
    torch.testing.assert_close(term("without_cue", None), 2 * each[kept].mean())
    expected = 2 * each[kept & ~with_cue].sum() / kept.sum()
    torch.testing.assert_close(term("without_cue", with_cue), expected)


@pytest.mark.usefixtures("eager")
def test_a_masked_view_is_measured_where_it_is_kept(scene, tmp_path):
    paint_all(scene)
    cli.cast(scene)
    trainer = trainer_of(scene, tmp_path)
    trainer.pipeline.eval()
    camera, batch = held_out(trainer)
    model, outputs = model_of(trainer), model_of(trainer).get_outputs_for_camera(camera)
    metrics, _ = model.get_image_metrics_and_images(outputs, batch)
    spoilt = outputs | {"rgb": torch.where(batch["mask"], outputs["rgb"], 1 - outputs["rgb"])}
    assert model.get_image_metrics_and_images(spoilt, batch)[0] == metrics
    assert "mask" in data_of(trainer).cached_train[0]


@pytest.mark.usefixtures("eager")
def test_a_fully_masked_photograph_is_refused_by_name(scene, tmp_path):
    paint(scene / "masks" / "frame_00002.png", left=48)
    with pytest.raises(SystemExit, match=r"shellgs: the mask .*masks/frame_00002.png is black everywhere"):
        trainer_of(scene, tmp_path, "photo_gs").train()


def test_masks_that_leave_nothing_of_any_view_are_refused(scene):
    for photograph in sorted((scene / "images").iterdir()):
        paint(scene / "shell" / "masks" / "images" / f"{photograph.name}.png", left=48)
    before = json.loads((scene / "cues" / "shell" / "manifest.json").read_text())
    with pytest.raises(SceneError, match=r"the masks of .* are black everywhere in every view: white is"):
        cli.cast(scene)
    assert json.loads((scene / "cues" / "shell" / "manifest.json").read_text()) == before
