"""User masks are found without a flag, and what they mask out is neither trained on nor measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import pinhole
from PIL import Image
from scenes import parse, views_of, write_colmap
from training_runs import data_of, held_out, model_of, trainer_of

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import image, image_errors
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.masks import kept_pixels
from shellgs_method.files.paths import mask_names, masks_among, photographs_in, tell_of_masks
from shellgs_method.files.photographs import load_mask, load_photograph
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.gaussians.seeds import shell_seeds, view_of_shell
from shellgs_method.losses.objective import ExtraLossConfig, SelfLosses
from shellgs_method.registration.validation import validate
from shellgs_method.render.maps import Geometry
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell


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
        write_colmap(scene, views_of(scene), list(range(1, 11)))
    paint_all(scene, name)
    for view in [*views_of(scene), *parse(scene).metadata["views"]]:
        kept = load_mask(view)
        assert kept is not None
        assert not kept[:, :12].any()
        assert kept[:, 12:].all()


def test_cameras_of_a_rig_share_their_masks_by_a_link(tmp_path):
    cameras = ("a", "left", "z")
    (tmp_path / "masks/left").mkdir(parents=True)
    paint(tmp_path / "masks/left/1.png", left=12)
    for camera in cameras:
        if camera != "left":
            (tmp_path / "masks" / camera).symlink_to("left")
    candidates = {camera: [tmp_path / "masks" / camera / "1.png"] for camera in cameras}
    assert masks_among(candidates) == {name: paths[0] for name, paths in candidates.items()}


def test_a_folder_with_links_to_it_is_found_by_its_own_path(tmp_path):
    (tmp_path / "images/m/deep").mkdir(parents=True)
    (tmp_path / "images/m/deep/1.jpg").touch()
    for name in "0abnz":
        (tmp_path / "images" / name).symlink_to("m" if name > "a" else "m/deep")
    (tmp_path / "images/m/loop").symlink_to("..")
    assert photographs_in(tmp_path / "images", deep=True) == [tmp_path / "images/m/deep/1.jpg"]


def test_a_photograph_without_a_mask_is_kept_whole_and_counted(scene, caplog):
    paint(scene / "masks" / "frame_00002.png", left=12)
    masks = [view.mask is not None for view in views_of(scene)]
    assert masks == [False, True, *[False] * 8]
    assert "9 of 10 photographs have no mask in" in caplog.text


def test_photographs_of_one_stem_that_share_a_mask_are_told(tmp_path, caplog):
    photographs = [Path("f0.jpg"), Path("f0.png"), Path("f1.jpg")]
    candidates = {path.name: [tmp_path / name for name in mask_names(path)] for path in photographs}
    for name in ("f0.png", "f1.png"):
        paint(tmp_path / name, left=12)
    tell_of_masks(masks_among(candidates), [], tmp_path)
    assert "1 masks in" in caplog.text
    assert "f0.png is that of f0.jpg and f0.png, for example; if it is not, name it f0.jpg.png, say" in caplog.text
    caplog.clear()
    (tmp_path / "f0.png").rename(tmp_path / "f0.jpg.png")  # then the other has none
    tell_of_masks(masks_among(candidates), [], tmp_path)
    assert "1 of 3 photographs have no mask" in caplog.text
    assert "several" not in caplog.text


def test_masks_that_belong_to_no_photograph_are_counted(scene, caplog):
    paint_all(scene)
    (scene / "masks" / "frame_00003.png").rename(scene / "masks" / "frame_0003.png")
    views_of(scene)
    assert "1 of 10 photographs have no mask" in caplog.text
    assert "1 files there belong to no photograph, frame_0003.png for example" in caplog.text


# What a mask keeps: the right half, in all of these

KEPT = np.zeros((32, 48), bool)
KEPT[:, 24:] = True
GREY = np.where(KEPT, 255, 0).astype(np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)


def with_alpha(colours: np.ndarray, alpha: np.ndarray) -> Image.Image:
    return Image.fromarray(np.dstack([colours, alpha]))


def in_palette(indices: np.ndarray, *colours: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(indices.astype(np.uint8)).convert("P")
    image = Image.frombytes("P", image.size, indices.astype(np.uint8).tobytes())
    image.putpalette([value for colour in colours for value in colour])
    return image


def soft(grey: np.ndarray) -> np.ndarray:
    """With a border between black and white, as of a mask that was resized."""
    ramp = np.linspace(0, 255, 9).round()
    softened = grey.astype(float)
    softened[:, 20:29] = ramp
    return softened.astype(np.uint8)


MASKS = {
    "255": Image.fromarray(GREY),
    "1": Image.fromarray(GREY // 255),
    "1 bit": Image.fromarray(KEPT),
    "16 bits": Image.fromarray(GREY.astype(np.uint16) * 257),
    "1 in 16 bits": Image.fromarray(KEPT.astype(np.uint16)),
    "255 in 16 bits": Image.fromarray(GREY.astype(np.uint16)),
    "1 in colours": Image.fromarray(np.dstack([GREY // 255] * 3)),
    "palette": in_palette(KEPT, (0, 0, 0), (255, 255, 255)),
    "inverse palette": in_palette(~KEPT, (255, 255, 255), (0, 0, 0)),
    "grey and alpha": Image.merge("LA", [Image.fromarray(GREY), Image.new("L", (48, 32), 255)]),
    "white and alpha": with_alpha(np.full((32, 48, 3), 255, np.uint8), GREY),
    "a cut-out": with_alpha(NOISE, GREY),
    "white in alpha only": Image.merge("LA", [Image.new("L", (48, 32), 255), Image.fromarray(GREY)]),
    "soft": Image.fromarray(soft(GREY)),
    "soft alpha": with_alpha(NOISE, soft(GREY)),
    "nearly white": Image.fromarray(np.where(KEPT, 250, 5).astype(np.uint8)),
}


@pytest.mark.parametrize("kind", MASKS)
def test_a_mask_of_any_form_keeps_what_is_white_and_opaque(tmp_path, kind):
    MASKS[kind].save(tmp_path / "mask.png")
    with Image.open(tmp_path / "mask.png") as image:
        np.testing.assert_array_equal(kept_pixels(image, tmp_path / "mask.png"), KEPT)


def test_a_jpeg_is_a_mask_in_spite_of_its_noise(tmp_path):
    Image.fromarray(GREY[:, ::-1]).rotate(7, fillcolor=255).save(tmp_path / "mask.jpg", quality=60)
    with Image.open(tmp_path / "mask.jpg") as image:
        assert 0.4 < kept_pixels(image, tmp_path / "mask.jpg").mean() < 0.7


@pytest.mark.parametrize("values", [(0, 0), (1, 1), (255, 255)])
def test_a_plain_mask_keeps_all_or_nothing(values):
    image = Image.fromarray(np.full((32, 48), values[0], np.uint8))
    assert (kept_pixels(image, Path("mask.png")) == (values[1] > 0)).all()


UNCLEAR = {
    "labels": (Image.fromarray(np.where(KEPT, 0, 13).astype(np.uint8)), "holds the values 0, 13, not black"),
    "labels beside white": (
        Image.fromarray(np.where(KEPT, 255, np.arange(32)[:, None] // 8 * 5).astype(np.uint8)),
        "holds the values 0, 5, 10, 15",
    ),
    "instances in 16 bits": (Image.fromarray(np.where(KEPT, 26001, 24003).astype(np.uint16)), "holds the values"),
    "three levels": (
        Image.fromarray(np.where(KEPT, 255, np.arange(32)[:, None] // 16 * 128).astype(np.uint8)),
        "holds the values 0, 128, 255",
    ),
    "colours": (in_palette(KEPT, (0, 0, 0), (128, 0, 128)), "is in colours"),
    "nothing opaque": (with_alpha(NOISE, 0 * GREY), "is transparent everywhere"),
    "black strokes": (with_alpha(0 * NOISE, GREY), "is black where it is opaque, and transparent elsewhere"),
}


@pytest.mark.parametrize("kind", UNCLEAR)
def test_a_mask_that_may_mean_several_things_is_refused(kind):
    image, words = UNCLEAR[kind]
    with pytest.raises(SceneError, match=f"the mask a/mask.png {words}.*white, which is kept"):
        kept_pixels(image, Path("a/mask.png"))


@pytest.mark.parametrize(
    "name",
    [
        "{name}.png",
        "{stem}.png",
        "{stem}.jpg",
        "{stem}_mask.png",
        "{name}_mask.png",
        "{name}.mask.png",
        "{stem}.mask.tif",
    ],
)
def test_masks_of_the_usual_names_are_found(scene, name):
    paint_all(scene, f"masks/{name}")
    assert all(view.mask for view in views_of(scene))


# Photographs with an alpha channel


def make_transparent(scene: Path, hidden: tuple[int, int, int] = (255, 0, 255), left: int = 12) -> None:
    """Photographs of which the columns left of ``left`` are transparent, with a colour that nobody sees."""
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            pixels = np.array(image.convert("RGBA"))
        pixels[:, :left] = (*hidden, 0)
        Image.fromarray(pixels).save(path)


@pytest.mark.parametrize("lens", [{}, {"k1": 0.05}])
def test_transparent_pixels_are_masked_and_their_colours_gone(scene, lens):
    transforms = json.loads((scene / "transforms.json").read_text()) | lens
    (scene / "transforms.json").write_text(json.dumps(transforms))
    view = views_of(scene)[3]
    opaque = load_photograph(view)
    assert load_mask(view) is None
    make_transparent(scene)
    kept, image = load_mask(view), load_photograph(view)
    assert kept is not None
    assert image.shape == (*kept.shape, 3)
    assert not kept[:, :10].any()
    assert kept[:, 14:].all()
    assert np.abs(image[kept].astype(int) - opaque[kept]).max() <= 2  # no colour bleeds over the border
    assert image[:, :10].max() == 0


def test_transparent_pixels_do_not_bleed_into_smaller_photographs(scene):
    view = parse(scene, max_image_size=24).metadata["views"][0]
    opaque = load_photograph(view)
    make_transparent(scene, left=13)
    kept = load_mask(view)
    assert kept is not None
    assert np.abs(load_photograph(view)[kept].astype(int) - opaque[kept]).max() < 40


def test_a_photographs_mask_and_alpha_channel_both_count(scene):
    make_transparent(scene)
    for path in (scene / "images").iterdir():
        Image.fromarray(np.repeat(np.where(np.arange(48) < 40, 255, 0)[None], 32, axis=0).astype(np.uint8)).save(
            scene / f"{path.stem}.png"
        )
    (scene / "masks").mkdir()
    for path in scene.glob("frame_*.png"):
        path.rename(scene / "masks" / path.name)
    kept = load_mask(views_of(scene)[0])
    assert kept is not None
    assert (kept == ((np.arange(48) >= 12) & (np.arange(48) < 40))).all()


@pytest.mark.parametrize("alpha", [255, 128])
def test_an_alpha_channel_that_hides_nothing_is_no_mask(scene, alpha):
    view = views_of(scene)[0]
    with Image.open(view.image) as image:
        image.putalpha(alpha)
        image.save(view.image)
    assert load_mask(view) is None


def test_a_photograph_that_is_transparent_everywhere_is_refused_by_name(scene):
    make_transparent(scene, left=48)
    view = views_of(scene)[0]
    for load in (load_mask, load_photograph):
        with pytest.raises(SceneError, match=r"frame_00001.png is transparent everywhere: remove its alpha channel"):
            load(view)


def test_hidden_colours_reach_neither_seeds_nor_training(scene, tmp_path):
    make_transparent(scene)
    cli.cast(scene, check=False)
    trainer = trainer_of(scene, tmp_path)
    seeds = shell_seeds(*data_of(trainer).seed_views(view_of_shell, "shell"), 1.0, 10_000)
    red, green, blue = seeds.colours.T
    assert len(seeds.points) > 100
    assert not ((red > green + 0.3) & (blue > green + 0.3)).any()
    for batch in data_of(trainer).cached_train:
        assert batch["image"].shape[-1] == 3
        assert not batch["mask"][:, :12].any()


def test_hidden_colours_change_nothing_in_the_check(scene):
    def checked(hidden: tuple[int, int, int]) -> np.ndarray:
        make_transparent(scene, hidden)
        cli.cast(scene)
        maps = CueMaps.open(scene, "checked")
        return np.stack([maps.require(view.name, view.camera).depth for view in views])

    views = views_of(scene)
    one, other = checked((255, 0, 255)), checked((0, 255, 0))
    np.testing.assert_array_equal(one, other)
    assert not one[:, :, :12].any()
    assert one.any()


def test_inverse_masks_are_refused_with_how_they_differ(scene):
    paint_all(scene, "masks/dynamic_mask_{stem}.png")
    with pytest.raises(SceneError, match=r"no photograph has a mask.*invert \(the white of dynamic_mask_"):
        views_of(scene)


def test_masks_of_no_photograph_are_refused(scene):
    paint(scene / "masks" / "elsewhere.png", left=12)
    with pytest.raises(SceneError, match=r"no photograph has a mask in .*masks/frame_00001.png.png; rename the masks"):
        views_of(scene)
    with pytest.raises(FileNotFoundError, match="painted is not a folder of masks"):
        views_of(scene, masks_path=Path("painted"))


def test_cast_leaves_masked_pixels_out_and_notices_changed_masks(scene):
    paint_all(scene)
    cli.cast(scene)
    maps, view = CueMaps.open(scene, "shell"), views_of(scene)[4]
    cue = maps.read(view.name, view.camera)
    assert cue is not None
    assert not cue.mask[:, :12].any()
    assert cue.mask[:, 12:].any()
    paint(scene / "masks" / "frame_00002.png", left=20)
    with pytest.raises(SceneError, match=r"masks has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


def test_align_validates_with_what_masks_keep(scene):
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh, config = load_shell(scene / alignment.shells[0]), FacadeDataParserConfig(data=scene)
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
        load_mask(views_of(scene)[1])


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
    camera = pinhole(9, 8, 6, dtype=torch.float32)
    depth, alpha, kept = torch.full((6, 8, 1), 5.0), torch.ones(6, 8, 1), torch.zeros(6, 8, 1, dtype=torch.bool)
    kept[:, 4:] = True
    extra = ExtraLossConfig(normal_consistency=1.0, normal_consistency_from=0, distortion=1.0)

    def terms(scale: float) -> dict[str, torch.Tensor]:
        changed = torch.where(kept, 1.0, scale)
        return SelfLosses(kept, None, extra)(Geometry(depth, changed * normal, alpha, camera, changed), 0.5)

    assert terms(1.0).keys() == {"normal_consistency", "distortion"}
    for name, value in terms(1.0).items():
        torch.testing.assert_close(terms(7.0)[name], value)
    assert terms(1.0)["distortion"] == 1


def test_normal_consistency_leaves_out_pixels_with_a_cue():
    normal = torch.randn(6, 8, 3, generator=torch.Generator().manual_seed(0))
    camera = pinhole(9, 8, 6, dtype=torch.float32)
    geometry = Geometry(torch.full((6, 8, 1), 5.0), normal, torch.ones(6, 8, 1), camera)
    kept, with_cue = torch.ones(6, 8, 1, dtype=torch.bool), torch.zeros(6, 8, 1, dtype=torch.bool)
    kept[0], with_cue[:, 4:] = False, True

    def term(with_cue: torch.Tensor | None) -> torch.Tensor:
        extra = ExtraLossConfig(normal_consistency=2.0, normal_consistency_from=0)
        return SelfLosses(kept, with_cue, extra)(geometry, 0.5)["normal_consistency"]

    each = 1 - (normal * geometry.depth_normal).sum(-1, keepdim=True)
    torch.testing.assert_close(term(None), 2 * each[kept].mean())
    expected = 2 * each[kept & ~with_cue].sum() / kept.sum()
    torch.testing.assert_close(term(with_cue), expected)


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
