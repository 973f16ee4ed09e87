"""Gaussians written to a file and read back must render like the model."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
from nerfstudio.scripts.exporter import ExportGaussianSplat
from scipy.spatial.transform import Rotation
from splat_files import of_glb, unpacked
from torch import Tensor
from training_runs import Method, data_of, held_out, model_of, render, trainer_of

from dataparsers.cameras import pinhole_camera
from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import lpips_network
from shellgs_method.export.levels import Level, psnr_of
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.splats import harmonics_rotation, moved
from shellgs_method.files.splats import Splats, read_splats, write_splats
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.doctor import examine
from shellgs_method.render.maps import Primitive
from shellgs_method.render.rasterizer import rasterize, spherical_harmonics
from shellgs_method.trainer import FacadeTrainer


def trained(scene: Path, folder: Path, method: Method, degree: int = 3) -> FacadeTrainer:
    """A short run with colours that depend on the view."""

    def change(config):
        config.pipeline.model.sh_degree = degree

    trainer = trainer_of(scene, folder, method, iterations=20, change=change)
    trainer.train()
    model = model_of(trainer)
    rest = model.gauss_params["features_rest"]
    rest.data = 0.1 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(0))
    model.step = model.num_iterations
    trainer.save_checkpoint(20)
    trainer.config.save_config()
    trainer.pipeline.eval()
    return trainer


@pytest.fixture(scope="module", params=["shellgs", "photo_gs", "two_dgs"])
def trainer(request, pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    return trained(pristine_scene, tmp_path_factory.mktemp(request.param), request.param)


def columns_of(path: Path) -> dict[str, Tensor]:
    """The attributes of a splat file; Open3D gives scales as lengths and opacities as logits."""
    cloud = o3d.t.io.read_point_cloud(str(path)).point  # pyright: ignore[reportArgumentType]
    return {name: torch.from_numpy(cloud[name].numpy().copy()) for name in cloud}


def render_of_file(path: Path, camera: Camera, primitive: Primitive) -> Tensor:
    """Render a file as a viewer does: Open3D reads it, and its Gaussians are rasterized on black."""
    column = columns_of(path)
    means, count = column["positions"], len(column["positions"])
    coefficients = column["f_dc"].view(count, 1, 3)
    if "f_rest" in column:
        coefficients = torch.cat([coefficients, column["f_rest"].view(count, -1, 3)], dim=1)
    degree = math.isqrt(coefficients.shape[1]) - 1
    colours = (spherical_harmonics(degree, means - camera.position.float(), coefficients) + 0.5).clamp_min(0)
    opacities = column["opacity"].sigmoid().squeeze(-1)
    camera = camera.to(dtype=torch.float32)
    return rasterize(means, column["rot"], column["scale"], opacities, colours, camera, primitive)[0].clamp(0, 1)


def ns_export(trainer: FacadeTrainer, folder: Path) -> Path:
    ExportGaussianSplat(load_config=trainer.base_dir / "config.yml", output_dir=folder).main()
    return folder / "splat.ply"


def test_the_file_of_ns_export_renders_like_the_model(trainer, tmp_path):
    camera, primitive = pinhole_camera(held_out(trainer)[0]), model_of(trainer).config.primitive
    read = render_of_file(ns_export(trainer, tmp_path), camera, primitive)
    assert read.std() > 0.05
    assert (read - render(trainer)["rgb"]).abs().max() < 2e-3


def test_viewers_of_gaussians_show_discs_like_the_model(pristine_scene, tmp_path):
    """They only support Gaussians, which are nearly discs if the third scale is tiny."""
    trainer = trained(pristine_scene, tmp_path, "two_dgs")
    path = ns_export(trainer, tmp_path)
    as_gaussians = render_of_file(path, pinhole_camera(held_out(trainer)[0]), "3d")
    assert (as_gaussians - render(trainer)["rgb"]).square().mean() < 10 ** (-25 / 10)
    scales = columns_of(path)["scale"]
    assert (scales > 0).all()
    assert (scales[:, 2] < scales[:, :2].amin(dim=1) / 1000).all()


def test_colours_without_harmonics_are_exported_too(pristine_scene, tmp_path):
    trainer = trained(pristine_scene, tmp_path, "photo_gs", degree=0)
    read = render_of_file(ns_export(trainer, tmp_path), pinhole_camera(held_out(trainer)[0]), "3d")
    assert (read - render(trainer)["rgb"]).abs().max() < 2e-3


def test_splats_in_the_shells_frame_look_the_same_from_the_same_place(trainer, tmp_path):
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.ply")
    run = TrainedRun(model_of(trainer), data_of(trainer))
    camera = run.frame.camera(data_of(trainer).eval_dataset.views[0].camera)
    read = render_of_file(tmp_path / "splats.ply", camera, model_of(trainer).config.primitive)
    difference = (read - render(trainer)["rgb"]).abs()
    assert difference.mean() < 1e-3
    assert difference.quantile(0.999) < 0.02


def test_splats_of_a_shell_whose_y_is_up_are_not_said_to_be_turned(pristine_scene, tmp_path, monkeypatch, capsys):
    trainer = trained(pristine_scene, tmp_path, "photo_gs", degree=0)
    frame = replace(TrainedRun(model_of(trainer), data_of(trainer)).frame, up=np.array([0.0, 1.0, 0.0]))
    monkeypatch.setattr(TrainedRun, "frame", frame)
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.glb")
    assert "Turned" not in capsys.readouterr().out


@pytest.mark.parametrize(("suffix", "read", "least"), [("glb", of_glb, 45), ("spz", unpacked, 38)])
def test_y_points_up_in_gltf_and_spz_and_what_they_show_is_the_same(
    trainer, tmp_path, monkeypatch, capsys, suffix, read, least
):
    path, primitive = tmp_path / f"splats.{suffix}", model_of(trainer).config.primitive
    if (suffix, primitive) == ("spz", "2d"):
        monkeypatch.setattr(TrainedRun, "load", None)  # refused before the run is loaded
        with pytest.raises(SceneError, match="spz has no discs"):
            cli.splats(trainer.base_dir / "config.yml", path)
        return
    cli.splats(trainer.base_dir / "config.yml", path)
    record = json.loads(Path(f"{path}.json").read_text())
    assert record["up"] == "y"
    shell_frame = TrainedRun(model_of(trainer), data_of(trainer)).frame
    offset = " ".join(f"{value:.0f}" for value in shell_frame.offset)
    assert f"minus {offset}. Turned, so that y is up." in " ".join(capsys.readouterr().out.split())
    frame, motion = shell_frame.turned(np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(record["turned"], motion[:3, :3])
    np.testing.assert_allclose(record["to_scene"], frame.to_scene)
    splats = read(path)
    camera = frame.camera(data_of(trainer).eval_dataset.views[0].camera).to(dtype=torch.float32)
    colours = spherical_harmonics(splats.degree, splats.means - camera.position, splats.harmonics) + 0.5
    opacities = splats.opacities.sigmoid().squeeze(-1)
    gaussians = (splats.means, splats.quats, splats.scales.exp(), opacities, colours.clamp_min(0))
    image = rasterize(*gaussians, camera, primitive)[0].clamp(0, 1)
    assert -10 * (image - render(trainer)["rgb"]).square().mean().log10() > least


def test_levels_have_half_as_many_gaussians_each_and_lose_less_than_if_the_rest_were_left_out(trainer, tmp_path):
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.ply", levels=3)
    run = TrainedRun(model_of(trainer), data_of(trainer))
    count, whole = run.model.num_points, Level.whole(run, run.splats())
    names = "splats", "splats-1", "splats-2"
    written = [read_splats(tmp_path / f"{name}.ply") for name in names]
    assert [len(each) for each in written] == [count, count >> 1, count >> 2]
    assert all(each.discs == whole.splats.discs for each in written)
    losses = [json.loads((tmp_path / f"{name}.ply.json").read_text())["psnr_loss"] for name in names]
    best = whole.splats[whole.shown.argsort(descending=True)[: count >> 2]]
    pruned = psnr_of(run, whole.splats, run.frame) - psnr_of(run, best, run.frame)
    assert losses[0] == 0
    assert losses[2] < pruned


def test_levels_are_measured_and_pages_drawn_over_the_background_of_the_run(trainer, tmp_path, monkeypatch):
    run = TrainedRun(model_of(trainer), data_of(trainer))
    monkeypatch.setattr(run.model, "background_color", torch.tensor([1.0, 0.5, 0.0]))
    views, errors = run.datasets[1], []
    for k in range(len(views)):
        image = run.model.get_outputs_for_camera(views.cameras[k : k + 1])["rgb"]
        errors.append((image - torch.from_numpy(views.get_numpy_image(k) / 255)).square().mean())
    expected = -10 * torch.stack(errors).log10().mean()
    assert psnr_of(run, run.splats(), run.frame) == pytest.approx(float(expected), abs=0.02)
    monkeypatch.setattr(TrainedRun, "load", lambda config: run)
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.html")
    assert '"background": [1.0, 0.5, 0.0]' in (tmp_path / "splats.html").read_text()
    assert json.loads((tmp_path / "splats.html.json").read_text())["background"] == [1, 0.5, 0]


def test_a_page_goes_through_the_photographs_in_the_order_of_their_names(trainer, tmp_path):
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.html")
    run = TrainedRun(model_of(trainer), data_of(trainer))
    frame, _ = run.frame.turned(np.array([0.0, 1.0, 0.0]))
    cameras = {view.name: frame.camera(view.camera) for dataset in run.datasets for view in dataset.views}
    page = (tmp_path / "splats.html").read_text().split('type="application/json">')[1].split("</script>")[0]
    eyes = [view["eye"] for view in json.loads(page)["views"]]
    np.testing.assert_allclose(eyes, [cameras[name].position for name in sorted(cameras)])


@pytest.mark.parametrize("levels", [1, 2])
def test_files_named_as_further_levels_are_kept_and_told_of(trainer, tmp_path, capsys, levels):
    names = ["splats-1.ply", "splats-2.ply"]
    for name in names:
        (tmp_path / name).write_text("of an earlier command")
    cli.splats(trainer.base_dir / "config.yml", tmp_path / "splats.ply", levels=levels)
    said = " ".join(capsys.readouterr().out.split())
    assert f"Not of these levels, and left as before: {', '.join(names[levels - 1 :])}." in said
    assert (tmp_path / names[-1]).read_text() == "of an earlier command"


def test_a_size_is_kept_to_the_byte(trainer, tmp_path):
    path = tmp_path / "splats.ply"
    cli.splats(trainer.base_dir / "config.yml", path)
    whole = path.stat().st_size
    cli.splats(trainer.base_dir / "config.yml", path, megabytes=0.6e-6 * whole)
    assert 0.55 * whole < path.stat().st_size <= 0.6 * whole


def test_gaussians_move_with_the_similarity():
    """Against covariances: S = R diag(s²) Rᵀ becomes A S Aᵀ."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    splats = Splats(normal(9, 3), normal(9, 4), normal(9, 3), normal(9, 1), normal(9, 16, 3))
    similarity = np.eye(4)
    similarity[:3, :3] = 2.5 * Rotation.from_euler("xyz", [30, -70, 110], degrees=True).as_matrix()
    similarity[:3, 3] = [1, 2, 3]

    def covariances(splats: Splats) -> np.ndarray:
        axes = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()
        axes = axes * splats.scales.exp().numpy()[:, None]
        return axes @ axes.transpose(0, 2, 1)

    there, A = moved(splats, similarity), similarity[:3, :3]
    np.testing.assert_allclose(covariances(there), A @ covariances(splats) @ A.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(there.means, splats.means.numpy() @ A.T + [1, 2, 3])
    np.testing.assert_array_equal(there.opacities, splats.opacities)


def rotations(count: int) -> list[Tensor]:
    return [
        torch.from_numpy(matrix)
        for matrix in Rotation.from_rotvec(np.random.default_rng(0).normal(0, 2, (count, 3))).as_matrix()
    ]


def test_rotated_harmonics_have_the_same_values_in_rotated_directions():
    generator = torch.Generator().manual_seed(2)
    directions = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    coefficients = torch.randn(16, 3, generator=generator, dtype=torch.float64)
    for R in rotations(5):
        turned = harmonics_rotation(R, 3) @ coefficients
        before = spherical_harmonics(3, directions, coefficients.expand(50, 16, 3))
        torch.testing.assert_close(spherical_harmonics(3, directions @ R.T, turned.expand(50, 16, 3)), before)


def test_rotating_harmonics_is_a_representation_of_the_rotations():
    """D(I) = I, D(R S) = D(R) D(S), D orthogonal, each degree by itself, and the first as the vectors (y, z, x)."""
    R, S = rotations(2)
    D = harmonics_rotation(R, 3)
    torch.testing.assert_close(harmonics_rotation(torch.eye(3, dtype=torch.float64), 3), torch.eye(16).double())
    torch.testing.assert_close(harmonics_rotation(R @ S, 3), D @ harmonics_rotation(S, 3))
    torch.testing.assert_close(D @ D.T, torch.eye(16).double())
    degrees = torch.arange(16).double().sqrt().long()
    assert D[degrees[:, None] != degrees].abs().max() < 1e-12
    order, signs = [1, 2, 0], torch.tensor([-1.0, 1, -1]).double()  # with the Condon-Shortley phase
    torch.testing.assert_close(D[1:4, 1:4], signs[:, None] * R[order][:, order] * signs)


def test_gaussians_with_nan_are_left_out(tmp_path):
    one = torch.ones(3, 1)
    splats = Splats(one.expand(3, 3).clone(), one.expand(3, 4), one.expand(3, 3), one, torch.ones(3, 4, 3))
    splats.means[1] = torch.nan
    assert write_splats(tmp_path / "splats.ply", splats) == 2
    assert len(columns_of(tmp_path / "splats.ply")["positions"]) == 2


def test_the_doctor_reports_where_it_looks_for_lpips_weights(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr("urllib.request.urlopen", None)  # it must not ask the network
    lpips_network.cache_clear()
    finding = next(finding for finding in examine() if finding.subject == "LPIPS weights")
    assert not finding.works
    assert not finding.needed
    assert str(tmp_path / "hub" / "checkpoints" / "alexnet") in finding.detail
    weights = tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    weights.parent.mkdir(parents=True)
    weights.touch()
    assert next(finding for finding in examine() if finding.subject == "LPIPS weights").works


@pytest.mark.parametrize("name", ["scene.splat", "scene"])
def test_splats_are_not_written_as_a_ply_under_another_name(tmp_path, name):
    with pytest.raises(SceneError, match=f"{name}: splats are written as ply, glb, spz or html: name a file"):
        cli.splats(tmp_path / "config.yml", tmp_path / name)
