"""The registered methods, the named ablations and the switches beyond the paper, inside nerfstudio."""

from __future__ import annotations

import copy
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from gsplat.strategy.ops import duplicate, remove
from nerfstudio.configs import external_methods
from nerfstudio.scripts.exporter import ExportGaussianSplat
from scenes import views_of
from torch.nn.functional import normalize
from training_runs import data_of, held_out, model_of, render, trainer_of

import method_configs
from dataparsers.cameras import pinhole_camera
from shellgs_method.compare.runs import PAPER
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.gaussians.initial import OPACITY
from shellgs_method.gaussians.seeds import Seeds
from shellgs_method.gaussians.surface_weights import SurfaceWeights
from shellgs_method.geometry.reference import Reference
from shellgs_method.losses import ExponentialDecay
from shellgs_method.losses.objective import CueLosses, ExtraLossConfig, GeometryLossConfig
from shellgs_method.render.maps import DISC_LOG_THICKNESS, depth_powers, geometry_channels, mode_of_depth
from shellgs_method.render.rasterizer import quats_to_rotations, rasterize
from shellgs_method.runs.ablations import ABLATIONS

METHODS = {
    "shellgs": "shellgs",
    "shellgs-metric": "shellgs_metric",
    "mono-gs": "mono_gs",
    "photo-gs": "photo_gs",
    "2dgs": "two_dgs",
}


@pytest.fixture
def mono_scene(scene: Path) -> Path:
    """The scene with the truth as the maps of a perfect network, and no shell."""
    truth = CueMaps.open(scene, "truth")
    mono = CueMaps.create(scene, "mono", command="shellgs mono {scene}")
    for view in views_of(scene):
        cue = truth.read(view.name, view.camera)
        assert cue is not None
        mono.write(view.name, CueMap(cue.depth, cue.normal, cue.mask), view.camera)
    shutil.rmtree(scene / "cues" / "shell")
    return scene


# The registry


def test_the_methods_are_registered_by_their_names():
    toml = pytest.importorskip("tomllib", reason="Python 3.11")
    project = toml.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
    entries = project["entry-points"]["nerfstudio.method_configs"]
    assert set(entries) == set(METHODS)
    for name, entry in entries.items():
        module, attribute = entry.split(":")
        assert getattr(import_module(module), attribute).config.method_name == name


def test_the_methods_are_points_of_primitive_and_cues():
    models = {name: getattr(method_configs, attribute).config.pipeline.model for name, attribute in METHODS.items()}
    assert {name: (model.primitive, model.cues) for name, model in models.items()} == {
        "shellgs": ("3d", "shell"),
        "shellgs-metric": ("3d", "shell"),
        "mono-gs": ("3d", "mono"),
        "photo-gs": ("3d", "none"),
        "2dgs": ("2d", "none"),
    }


def test_the_papers_methods_start_from_the_sfm_points_alone():
    """They differ in supervision, not in initialization."""
    models = {name: getattr(method_configs, attribute).config.pipeline.model for name, attribute in METHODS.items()}
    assert {name for name, model in models.items() if model.init != "sfm"} == {"shellgs-metric"}
    assert "shellgs-metric" not in PAPER


def test_methods_that_are_not_installed_are_listed_in_no_time_and_offered_if_chosen(monkeypatch):
    asked = []
    monkeypatch.setattr("inspect.stack", lambda: pytest.fail("takes seconds"))
    monkeypatch.setattr("rich.prompt.Confirm.ask", lambda *_, **__: asked.append(1))
    methods, _ = external_methods.get_external_methods()
    assert not asked
    with pytest.raises(SystemExit):
        replace(next(iter(methods.values())))
    assert asked


def parsed(words: tuple[str, ...]):
    """The config that ns-train makes of a method and its flags."""
    default = copy.deepcopy(getattr(method_configs, METHODS[words[0]]).config)
    return tyro.cli(type(default), default=default, args=words[1:])


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("shellgs-depth", {"depth"}),
        ("shellgs-normal", {"normal"}),
        ("shellgs-depth-normal", {"depth", "normal"}),
    ],
)
def test_an_ablation_leaves_out_the_terms_it_does_not_name(name, kept):
    geometry = parsed(ABLATIONS[name]).pipeline.model.geometry
    assert {term for term in ("depth", "normal", "smoothness") if getattr(geometry, term)(0.5) > 0} == kept


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_is_a_registered_method_with_something_changed(name):
    config = parsed(ABLATIONS[name])
    assert config.pipeline != getattr(method_configs, METHODS[ABLATIONS[name][0]]).config.pipeline


# 2dgs


@pytest.fixture(scope="module")
def discs(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory):
    """A 2dgs run of 30 iterations that densifies every 5 from the third on."""

    def densify(config):
        model = config.pipeline.model
        model.warmup_length, model.refine_every, model.densify_grad_thresh = 2000, 5, 1e-6
        model.extra = ExtraLossConfig(normal_consistency=0.05, normal_consistency_from=0, distortion=10.0)

    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), "two_dgs", iterations=30, change=densify)
    model_of(trainer).strategy.grow_scale3d = 1e-3  # split discs, too
    trainer.train()
    trainer.pipeline.eval()
    return trainer


def test_2dgs_trains_to_more_discs_of_no_thickness(discs):
    model = model_of(discs)
    assert model.num_points > 320
    assert (model.scales[:, 2] == DISC_LOG_THICKNESS).all()
    assert all(parameter.isfinite().all() for parameter in model.gauss_params.values())


def test_a_disc_splits_within_its_plane(discs):
    """Gsplat's own split of the model's discs scatters children along the first two axes alone."""
    model = model_of(discs)
    params = torch.nn.ParameterDict({name: value.detach().clone() for name, value in model.gauss_params.items()})
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    n = model.num_points
    ones = {name: torch.ones(n) for name in ("grad2d", "count", "radii")}
    state = ones | {"scene_scale": 0.0}  # all are large: all split
    duplicated, split = model.strategy._grow_gs(params, optimizers, state, step=1)  # pyright: ignore
    assert (duplicated, split) == (0, n)
    offsets = params["means"].detach().view(2, n, 3) - model.means.detach()
    axes = quats_to_rotations(model.quats.detach())
    u, v, w = ((offsets * axes[..., i]).sum(-1) / model.scales.detach()[:, :2].exp().amax(-1) for i in range(3))
    assert u.abs().median() > 0.1
    assert v.abs().median() > 0.1
    assert w.abs().max() < 1e-3


def test_the_normal_of_a_disc_is_its_third_axis(discs):
    assert (model_of(discs).scales.argmin(dim=-1) == 2).all()


def test_2dgs_renders_images_and_has_its_own_losses(discs):
    outputs, (_, batch) = render(discs), held_out(discs)
    assert {name: image.shape[2] for name, image in outputs.items()} == {
        "rgb": 3,
        "accumulation": 1,
        "background": 3,
        "depth": 1,
        "normal": 3,
    }
    assert all(image.isfinite().all() for image in outputs.values())
    losses = model_of(discs).get_loss_dict(outputs, batch)
    assert losses.keys() == {"photometric", "normal_consistency", "distortion"}


def test_the_terms_of_2dgs_start_at_their_iterations(discs):
    model, (_, batch) = model_of(discs), held_out(discs)
    outputs, extra = render(discs), model.objective.extra
    model.objective.extra = ExtraLossConfig(normal_consistency=0.05, distortion=10.0)  # from 7000 and 3000 of 30 000
    terms = []
    for model.step in (2, 3, 6, 7):  # of 30
        terms.append(model.get_loss_dict(outputs, batch).keys() - {"photometric"})
    model.objective.extra = extra
    assert terms == [set(), {"distortion"}, {"distortion"}, {"distortion", "normal_consistency"}]


def test_exported_discs_are_finite(discs, tmp_path, monkeypatch):
    monkeypatch.setattr("nerfstudio.scripts.exporter.eval_setup", lambda *_, **__: (None, discs.pipeline, None, None))
    ExportGaussianSplat(load_config=Path(), output_dir=tmp_path).main()
    data = (tmp_path / "splat.ply").read_bytes().split(b"end_header\n")[1]
    values = np.frombuffer(data, np.float32).reshape(model_of(discs).num_points, -1)
    assert np.isfinite(values).all()


def test_distortion_of_3d_gaussians_is_refused(pristine_scene, tmp_path):
    def ask(config):
        config.pipeline.model.extra = ExtraLossConfig(distortion=1.0)

    with pytest.raises(SystemExit, match=r"set pipeline\.model\.primitive to 2d"):
        trainer_of(pristine_scene, tmp_path, change=ask)


# Primitive x cues


def test_discs_can_be_supervised_by_the_shell(pristine_scene, tmp_path):
    def discs(config):
        config.pipeline.model.primitive = "2d"

    trainer = trainer_of(pristine_scene, tmp_path, iterations=20, change=discs)
    before = _normal_error(trainer)
    trainer.train()
    assert _normal_error(trainer) < before - 1
    trainer.pipeline.eval()
    losses = model_of(trainer).get_loss_dict(render(trainer), held_out(trainer)[1])
    assert losses.keys() == {"photometric", "depth", "normal", "smoothness"}


def test_mono_gs_learns_from_mono_maps_without_a_shell(mono_scene, tmp_path):
    trainer = trainer_of(mono_scene, tmp_path, "mono_gs", iterations=20)
    _, batch = held_out(trainer)
    before = _normal_error(trainer, "truth")
    trainer.train()
    assert _normal_error(trainer, "truth") < before - 1
    trainer.pipeline.eval()
    assert model_of(trainer).get_loss_dict(render(trainer), batch).keys() >= {"depth", "normal", "smoothness"}


def test_mono_gs_without_its_maps_ends_with_one_sentence(scene, tmp_path):
    with pytest.raises(SystemExit, match=r"this method needs the mono maps .* run `shellgs mono SCENE`"):
        trainer_of(scene, tmp_path, "mono_gs")


def _normal_error(trainer, reference: str = "shell") -> float:
    trainer.pipeline.eval()
    metrics, _ = model_of(trainer).get_image_metrics_and_images(render(trainer), held_out(trainer)[1])
    trainer.pipeline.train()
    return metrics["normal_deg" if reference == "shell" else f"{reference}_normal_deg"]


# Switches beyond the paper

NONE = ExponentialDecay(0, 0)
OFF = GeometryLossConfig(NONE, NONE, NONE)


@pytest.fixture(scope="module")
def untrained(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory):
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"))
    trainer.pipeline.eval()
    return trainer


def rendered(trainer) -> tuple:
    """Geometry of a training view, with gradients, and the shell's maps."""
    camera, batch = data_of(trainer).next_train(0)
    model = model_of(trainer)
    model(camera)
    return model.geometry, Reference(batch["shell_depth"], batch["shell_normal"].float(), batch["shell_mask"])


def terms(geometry, cue, progress: float = 0.5, paper: GeometryLossConfig = OFF, metres: float | None = 2.0, **extra):
    return CueLosses(cue, cue.mask.to(cue.depth), paper, ExtraLossConfig(**extra), metres)(geometry, progress)


def test_all_switches_are_off_in_the_papers_setting(untrained):
    geometry, cue = rendered(untrained)
    assert terms(geometry, cue, paper=GeometryLossConfig()).keys() == {"depth", "normal", "smoothness"}


def test_normals_of_depth_have_a_depth_gradient_and_composited_ones_have_none(untrained):
    """Shifting all splats of a pixel along its ray changes the normals of depth, but not the composited ones."""
    geometry, cue = rendered(untrained)
    (loss,) = terms(geometry, cue, depth_normal=0.1).values()
    (gradient,) = torch.autograd.grad(loss, geometry.depth, retain_graph=True)
    assert gradient.abs().sum() > 0
    (only_n,) = terms(
        geometry, cue, paper=GeometryLossConfig(OFF.depth, ExponentialDecay(1, 1), OFF.smoothness)
    ).values()
    assert torch.autograd.grad(only_n, geometry.depth, allow_unused=True) == (None,)


def exchange(params, optimizers) -> None:
    """Add as many Gaussians as are removed."""
    first = torch.zeros(len(params["means"]), dtype=torch.bool)
    first[: len(first) // 10] = True
    duplicate(params, optimizers, {}, first)
    remove(params, optimizers, {}, torch.cat([first, torch.zeros(int(first.sum()), dtype=torch.bool)]))


def test_whether_gaussians_are_behind_the_shell_is_found_anew_when_these_are_others(untrained, monkeypatch):
    model = model_of(untrained)
    params = copy.deepcopy(model.gauss_params)
    optimizers = {name: torch.optim.Adam([parameter]) for name, parameter in params.items()}
    middle, x = params["means"].detach().median(dim=0).values[None].numpy(), np.array([[1.0, 0.0, 0.0]])
    weights = SurfaceWeights(Seeds(middle, -x, x, np.ones(1)), metres_per_unit=None)
    monkeypatch.setitem(model._modules, "gauss_params", params)
    monkeypatch.setitem(model._buffers, "surface", None)
    monkeypatch.setattr(model, "surface_weights", weights)
    model.update_surface()
    before = model.surface
    assert before is not None
    assert before.min() < before.max()
    model.update_surface()
    assert model.surface is before
    exchange(params, optimizers)
    model.update_surface()
    after = model.surface
    assert after is not None
    assert after.shape == before.shape
    assert not torch.equal(after, before)
    assert torch.equal(after, weights(params["means"]))


def test_the_mode_is_rendered_and_the_losses_are_of_the_expected_depth(untrained, monkeypatch):
    """With a weight of 0, what is behind the shell is in neither of the two layers."""
    model, (camera, _) = model_of(untrained), held_out(untrained)
    surface = torch.ones(model.num_points, 1)
    surface[::2] = 0
    monkeypatch.setitem(model._buffers, "surface", surface)
    monkeypatch.setattr("shellgs_method.render.view.PAST", 0.0)
    depths = {}
    for kind in ("expected", "mode"):
        monkeypatch.setattr(model, "renderer", replace(model.renderer, depth=kind))
        depths[kind] = render(untrained)["depth"]
        assert model.geometry is not None
        assert torch.equal(model.geometry.depth, depths["expected"])  # what losses are computed on
    view, everything = pinhole_camera(camera), {name: each.detach() for name, each in model.gauss_params.items()}
    powers, median = depth_powers(geometry_channels(everything, view, "expected")[1])
    powers[::2] = 0
    shape = everything["means"], everything["quats"], everything["scales"].exp()
    composited, _, _ = rasterize(*shape, everything["opacities"].sigmoid()[:, 0], powers, view, "3d")
    mode = mode_of_depth(depths["expected"], composited, median)
    torch.testing.assert_close(depths["mode"], mode)
    assert ((mode / depths["expected"] - 1).abs() > 0.05).sum() > 20


def test_empty_space_is_of_all_splats_and_in_metres(untrained, monkeypatch):
    model = model_of(untrained)
    monkeypatch.setattr(model, "renderer", replace(model.renderer, moments=True))
    geometry, cue = rendered(untrained)
    shifted = Reference(geometry.depth.detach() + 0.5, cue.normal, torch.ones_like(cue.mask))
    slope = (normalize(shifted.normal, dim=-1) * geometry.camera.rays()).sum(-1, keepdim=True).abs()
    squares = geometry.moments.about(shifted.depth, geometry.alpha)
    distance = ((2.0 * slope).square() * squares + 1 - geometry.alpha).sqrt()
    expected = (0.2 * ((distance - 0.1).clamp_min(0) / 0.2).log1p()).mean()
    (loss,) = terms(geometry, shifted, empty_space=1.0, tolerance=0.1).values()
    torch.testing.assert_close(loss, expected)


@pytest.mark.parametrize(("error", "expected"), [(None, 0.05), (0.003, 0.05), (0.08, 0.08), (0.5, 0.15)])
def test_the_tolerance_follows_the_error_of_the_alignment(error, expected):
    assert ExtraLossConfig().tolerance_for(error) == expected
    assert ExtraLossConfig(tolerance=0.3).tolerance_for(error) == 0.3


def test_empty_space_needs_depths_of_centres(pristine_scene, tmp_path):
    def choose(config):
        config.pipeline.model.depth = "plane"

    with pytest.raises(SystemExit, match="empty_space"):
        trainer_of(pristine_scene, tmp_path, "shellgs_metric", change=choose)


def test_surfaces_continue_without_a_cue_and_not_where_something_is_in_front_of_the_shell(untrained):
    model, (camera, batch) = model_of(untrained), data_of(untrained).next_train(0)
    extra, cued = model.objective.extra, torch.ones_like(batch["shell_mask"])
    in_front = 0.9 * batch["shell_depth"].where(cued, 0.0)

    def consistency(cued: torch.Tensor) -> float:
        changed = {**batch, "shell_mask": cued, "other_depth": in_front}
        return float(model.get_loss_dict(model(camera), changed)["normal_consistency"])

    model.objective.extra = ExtraLossConfig(normal_consistency=1.0, normal_consistency_from=0)
    without, half, everywhere = (consistency(mask) for mask in (~cued, cued & (torch.rand(cued.shape) < 0.5), cued))
    model.objective.extra = extra
    assert without > half > everywhere == 0


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_shellgs_metric_brings_the_surface_to_the_shell(pristine_scene, tmp_path, monkeypatch, primitive):
    def choose(config):
        config.pipeline.model.primitive = primitive

    # 60 iterations are too few to make opaque SfM points transparent,
    monkeypatch.setitem(OPACITY, "shell", 0.1)
    if primitive == "2d":  # and to make discs of the wall, whose depths include the sky's, opaque.
        nothing = Seeds(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
        monkeypatch.setattr("shellgs_method.pipeline.skybox_seeds", lambda *_: nothing)

    def score(method) -> float:
        trainer = trainer_of(pristine_scene, tmp_path / method, method, iterations=60, change=choose)
        trainer.train()
        return trainer.pipeline.get_average_eval_image_metrics()["f_score_20cm"]

    assert score("shellgs_metric") > 1.3 * score("shellgs")


def test_the_flattening_term_is_the_mean_thickness_of_the_visible_gaussians(untrained):
    model = model_of(untrained)
    model.objective.extra = ExtraLossConfig(flattening=100.0)
    outputs = render(untrained)
    visible = model.info["radii"][0] > 0
    loss = model.get_loss_dict(outputs, held_out(untrained)[1])["flattening"]
    model.objective.extra = ExtraLossConfig()
    assert 0 < int(visible.sum()) < model.num_points
    torch.testing.assert_close(loss, 100 * model.scales[visible].exp().amin(dim=-1).mean())


def test_flattening_is_in_units_of_the_size_of_the_camera_path(untrained):
    """Nerfstudio rescales every scene to it, so that a weight means the same in each."""
    outputs = data_of(untrained).train_dataparser_outputs
    assert outputs.cameras.camera_to_worlds[:, :, 3].abs().max() == pytest.approx(1, rel=0.2)


@pytest.mark.parametrize("depth", ["plane", "median"])
def test_every_depth_trains(pristine_scene, tmp_path, depth):
    def choose(config):
        config.pipeline.model.depth = depth
        config.pipeline.model.primitive = {"plane": "3d", "median": "2d"}[depth]

    trainer = trainer_of(pristine_scene, tmp_path, iterations=5, change=choose)
    trainer.train()
    assert all(parameter.isfinite().all() for parameter in model_of(trainer).gauss_params.values())
