"""Cameras that are bent are straightened by the shell, others and wrong shells are left alone."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import cast
from scipy.spatial.transform import Rotation

from dataparsers.facade import read_views
from shellgs_method.commands.align import AlignConfig, align
from shellgs_method.errors import SceneError
from shellgs_method.files.colmap import (
    KEYPOINT,
    ColmapCamera,
    ColmapImage,
    Model,
    Points,
    read_model,
    tracks_of,
    write_model,
)
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.scene import ADJUSTED, ScenePaths
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.similarity import fit_similarity, transformed
from shellgs_method.registration.adjustment import FEW, SIGNIFICANT, Adjustment, Mixture, adjusted
from shellgs_method.registration.picks import PickedPoint
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.path import walk

FACES = np.array([[0, 1, 2], [0, 2, 3]])
VIEWS, WIDTH, HEIGHT, NOISE = 24, 640, 480, 0.3
CAMERAS = walk(15.0, VIEWS, WIDTH, HEIGHT, np.random.default_rng(0))
CENTRES = np.stack([camera.position.numpy() for camera in CAMERAS])
NAMES = {number: f"{number:02d}.png" for number in range(1, VIEWS + 1)}
ORIGINAL = ScenePaths(colmap_path=Path("colmap/sparse/0"))


def building(layout: Layout) -> ShellMesh:
    """The shell in the building's own frame, in metres: x along the front, y into it, z up."""
    mesh = shell(layout)
    return ShellMesh(mesh.vertices, mesh.triangles)


@pytest.fixture(scope="module")
def surface() -> ShellSurface:
    return ShellSurface(building(Layout(5, 3)))


def tracked(surface: ShellSurface, seed: int) -> Model:
    """The true cameras, and tracks of points of the front over a few neighbours, some of them wrong."""
    random = np.random.default_rng(seed)
    points, _ = surface.samples(9000)
    points = transformed(points, np.linalg.inv(surface.survey_from_shell))
    points = points[points[:, 1] < 0.3][:2500]
    first = random.integers(0, VIEWS, len(points))
    observed = []
    for number, camera in enumerate(CAMERAS):
        inside, pixels, _ = in_view(camera, points)
        everything = np.zeros((len(points), 2))
        everything[inside] = pixels + random.normal(0, NOISE, pixels.shape)
        wrong = random.random(len(points)) < 0.03
        everything[wrong] += random.normal(0, 4, (wrong.sum(), 2))
        observed.append((inside & (np.abs(first - number) <= 3), everything))
    seen = np.stack([which for which, _ in observed])
    kept = np.flatnonzero(seen.sum(axis=0) >= 3)
    images, camera = {}, CAMERAS[0].K.numpy()
    for number, (_, pixels) in enumerate(observed, start=1):
        features = np.empty(len(kept), KEYPOINT)
        features["xy"], features["point"] = (
            pixels[kept],
            np.where(seen[number - 1, kept], np.arange(1, len(kept) + 1), -1),
        )
        x, y, z, w = Rotation.from_matrix(CAMERAS[number - 1].viewmat[:3, :3].numpy()).as_quat()
        translation = tuple(CAMERAS[number - 1].viewmat[:3, 3].tolist())
        images[number] = ColmapImage((w, x, y, z), translation, 1, f"{number:02d}.png", features)
    point, view = np.nonzero(seen[:, kept].T)
    colours = np.full((len(kept), 3), 128, np.uint8)
    known = Points(points[kept], colours, tracks_of(point, view + 1, point), np.arange(1, len(kept) + 1))
    K = (camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2])
    return Model({1: ColmapCamera("PINHOLE", WIDTH, HEIGHT, K)}, images, known)


@pytest.fixture(scope="module")
def model(surface: ShellSurface) -> Model:
    return tracked(surface, 7)


@pytest.fixture(scope="module")
def bent(model: Model) -> Model:
    return like_a_banana(model)


def like_a_banana(model: Model) -> Model:
    """The model bent like a banana about the middle of the front, by 10 cm at the ends, cameras turned with it."""
    strength = 0.1 / 7.5**2

    def moved(points: np.ndarray) -> np.ndarray:
        along, out = points[:, 0] - 7.5, points[:, 1]
        return points + np.stack([-2 * strength * along * out, strength * along**2, 0 * out], axis=1)

    images = {}
    for (number, image), camera in zip(model.images.items(), CAMERAS, strict=True):
        centre = camera.position.numpy()
        turn = Rotation.from_rotvec([0, 0, 2 * strength * (centre[0] - 7.5)]).as_matrix()
        rotation = camera.viewmat[:3, :3].numpy() @ turn.T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        translation = tuple((-rotation @ moved(centre[None])[0]).tolist())
        images[number] = image._replace(quaternion=(w, x, y, z), translation=translation)
    return replace(model, images=images, points=replace(model.points, positions=moved(model.points.positions)))


def centres(model: Model) -> np.ndarray:
    found = []
    for image in model.images.values():
        rotation = Rotation.from_quat(np.array(image.quaternion)[[1, 2, 3, 0]]).as_matrix()
        found.append(-rotation.T @ np.array(image.translation))
    return np.stack(found)


def error(surface: ShellSurface, found: Adjustment) -> np.ndarray:
    """Distance of each camera's centre from the true one, in the frame of the shell, in metres."""
    in_survey = transformed(centres(found.model), found.survey_from_scene)
    return np.linalg.norm(in_survey - transformed(CENTRES, surface.survey_from_shell), axis=1)


def write(scene: Path, model: Model, mesh: ShellMesh, alignment: np.ndarray | None = None) -> Path:
    """A scene of a model, its shell and a file of the matrix; return that."""
    import open3d as o3d

    (scene / "colmap/sparse").mkdir(parents=True)
    (scene / "images").mkdir()
    write_model(scene / "colmap/sparse/0", model, np.zeros(len(model.points.ids)))
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for image in model.images.values():
        Image.fromarray(picture).save(scene / "images" / image.name)
    solid = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    o3d.io.write_triangle_mesh(scene / "shell.ply", solid)
    matrix = scene / "matrix.txt"
    np.savetxt(matrix, np.eye(4) if alignment is None else alignment)
    return matrix


@pytest.mark.parametrize("above", [0, 2**32 - 1000])
def test_a_model_is_read_as_it_was_written(tmp_path: Path, model: Model, above: int):
    """COLMAP's numbers have 32 bits without a sign, those of points 64."""
    tracks = model.points.tracks.copy()
    tracks["image"] += above
    points = replace(model.points, tracks=tracks, ids=model.points.ids - above)
    model = replace(model, images={number + above: image for number, image in model.images.items()}, points=points)
    write_model(tmp_path / "model", model, np.zeros(len(model.points.ids)))
    again = read_model(tmp_path / "model")
    assert again.cameras == model.cameras
    for number, image in model.images.items():
        assert again.images[number][:4] == image[:4]
        np.testing.assert_array_equal(again.images[number].features, image.features)
    np.testing.assert_array_equal(again.points.positions, model.points.positions)
    np.testing.assert_array_equal(again.points.tracks, model.points.tracks)
    np.testing.assert_array_equal(again.points.ids, model.points.ids)


@pytest.fixture(scope="module")
def unbent(surface: ShellSurface, bent: Model) -> Adjustment:
    return adjusted(surface, bent, surface.survey_from_shell, NAMES)


def test_bent_cameras_are_straightened(surface: ShellSurface, bent: Model, unbent: Adjustment):
    before = np.linalg.norm(centres(bent) - CENTRES, axis=1)
    after = error(surface, unbent)
    assert before.mean() > 0.03
    assert after.mean() < 0.015
    assert after.mean() < 3 * np.median(list(unbent.deviations.values()))
    assert unbent.held_out.gain > 2 * SIGNIFICANT
    assert unbent.held_out.pixels[1] < 1.05 * unbent.held_out.pixels[0]


def test_a_wall_that_unbending_moves_to_the_edge_of_reach_is_found(surface: ShellSurface):
    """With this noise, cameras that keep their places on average unbend so that the wall is 27 cm from the shell."""
    found = adjusted(surface, like_a_banana(tracked(surface, 5)), surface.survey_from_shell, NAMES)
    assert error(surface, found).mean() < 0.015
    assert found.held_out.gain > 2 * SIGNIFICANT


def test_of_few_tracks_more_are_held_out(surface: ShellSurface, bent: Model):
    few = bent.points.taken(np.sort(np.random.default_rng(1).permutation(len(bent.points.ids))[:450]))
    found = adjusted(surface, replace(bent, points=few), surface.survey_from_shell, NAMES)
    assert found.held_out.points > FEW
    assert found.held_out.gain > SIGNIFICANT


def test_the_scene_keeps_its_frame(bent: Model, unbent: Adjustment):
    common = fit_similarity(unbent.model.points.positions, bent.points.positions)
    np.testing.assert_allclose(common[:3, :3], np.eye(3), atol=0.005)
    assert np.linalg.norm(common[:3, 3]) < 0.1


def test_cameras_that_are_straight_move_by_what_their_deviation_allows(surface: ShellSurface, model: Model):
    found = adjusted(surface, model, surface.survey_from_shell, NAMES)
    moved, deviations = (np.array(list(by.values())) for by in (found.moved, found.deviations))
    assert np.median(moved) < 2 * np.median(deviations)  # their errors are alike: a lens and a place are shared
    assert found.held_out.were_straight


def test_surveyed_positions_draw_cameras_to_them(surface: ShellSurface, bent: Model):
    known = dict(zip(NAMES.values(), transformed(CENTRES, surface.survey_from_shell), strict=True))
    found = adjusted(surface, bent, surface.survey_from_shell, NAMES, known, 0.001)
    assert error(surface, found).max() < 0.003


def test_points_are_told_from_those_beside_the_shell():
    """A wall with few other points, and reveals with hardly any but those of frames, all on one side of them."""
    random = np.random.default_rng(0)
    of_shell, deviation = np.repeat([True, False, True, False], [800, 200, 40, 300]), random.uniform(0.003, 0.02, 1340)
    facing = np.repeat([0, 1], [1000, 340])
    distance = np.where(of_shell, random.normal(0, np.hypot(0.01, deviation)), random.uniform(-0.01, 0.1, 1340))
    found = Mixture.of(distance, deviation, facing, 0.1)
    probability = found.probability
    assert found.sigma[0] == pytest.approx(0.01, rel=0.2)
    shares = [probability[facing == side].mean() for side in (0, 1)]
    assert shares[0] == pytest.approx(0.8, abs=0.1)
    assert shares[1] == pytest.approx(40 / 340, abs=0.15)
    close = np.abs(distance) < 0.01
    assert probability[close & (facing == 0)].mean() > 0.2 + probability[close & (facing == 1)].mean()


def test_each_side_has_its_own_noise():
    random = np.random.default_rng(0)
    facing, deviation = np.repeat([0, 1], 1000), np.full(2000, 0.005)
    distance = np.concatenate([random.normal(0, np.hypot(noise, 0.005), 1000) for noise in (0.01, 0.03)])
    np.testing.assert_allclose(Mixture.of(distance, deviation, facing, 0.1).sigma, [0.01, 0.03], rtol=0.1)


def test_a_mixture_s_density_is_one_in_all():
    distance = np.linspace(-0.1, 0.1, 2001)
    found = Mixture.of(distance, np.full(2001, 0.01), np.zeros(2001, np.int64), 0.1)
    assert found.likelihood.mean() * 0.2 == pytest.approx(1.0, abs=0.02)


def test_picks_say_where_along_a_bare_wall_it_is(surface: ShellSurface, model: Model):
    """The wall's points say nothing of a shift along it, and picks with 1 cm of noise do, as their number allows."""
    wall = ShellSurface(ShellMesh(np.array([[-50.0, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]]), FACES))
    on_wall = np.abs(model.points.positions[:, 1]) < 0.01
    bare = model.points.taken(np.flatnonzero(on_wall))
    model = replace(model, points=bare)
    survey_from_scene = wall.survey_from_shell.copy()
    survey_from_scene[0, 3] += 0.1
    random = np.random.default_rng(0)
    picked = [point for point in bare.positions[::20] if 2 < point[0] < 13][:16]
    picks = []
    for number, place in enumerate(picked):
        seen = tuple(NAMES[k + 1] for k, camera in enumerate(CAMERAS) if len(in_view(camera, place[None])[1]))[::3]
        shell = place + random.normal(0, 0.01, 3)
        picks.append(PickedPoint(str(number), shell, place, False, True, 0.1, 0.1, 0.1, seen[0], True, seen))
    with_picks, without = (error(wall, adjusted(wall, model, survey_from_scene, NAMES, picks=p)) for p in (picks, []))
    assert without.mean() > 0.05
    assert with_picks.mean() < 0.02


def test_points_that_are_nan_and_lenses_without_photographs_change_nothing(surface: ShellSurface, bent: Model):
    positions = bent.points.positions.copy()
    positions[::50] = np.nan
    unused = ColmapCamera("FULL_OPENCV", WIDTH, HEIGHT, (500.0, 500.0, 320.0, 240.0) + 8 * (0.0,))
    damaged = replace(bent, cameras={7: unused, **bent.cameras}, points=replace(bent.points, positions=positions))
    found = adjusted(surface, damaged, surface.survey_from_shell, NAMES)
    assert np.isfinite(found.model.points.positions).all()
    assert list(found.model.cameras) == [1]
    assert error(surface, found).mean() < 0.02


def test_a_model_without_tracks_is_refused(surface: ShellSurface, model: Model):
    with pytest.raises(SceneError, match="have no tracks"):
        adjusted(
            surface,
            replace(model, points=replace(model.points, tracks=model.points.tracks[:0])),
            surface.survey_from_shell,
            NAMES,
        )


def test_points_that_one_photograph_sees_each_are_refused(surface: ShellSurface, model: Model):
    """Networks such as VGGT write each pixel's point with itself as its track."""
    first = np.unique(model.points.tracks["point"], return_index=True)[1]
    alone = replace(model, points=replace(model.points, tracks=model.points.tracks[first]))
    with pytest.raises(SceneError, match="only 0 SfM points are seen in 3 photographs or more"):
        adjusted(surface, alone, surface.survey_from_shell, NAMES)


def test_the_command_unbends_and_one_switch_goes_back(tmp_path: Path, surface: ShellSurface, bent: Model):
    matrix = write(tmp_path, bent, building(Layout(5, 3)))
    files = {path: path.read_bytes() for path in (tmp_path / "colmap/sparse/0").iterdir()}
    align(tmp_path, AlignConfig((tmp_path / "shell.ply",), matrix=matrix, refine=0.3, bundle_adjust=True))
    assert Alignment.load(tmp_path / ALIGNMENT).model == ADJUSTED.as_posix()
    layout = ScenePaths().of(tmp_path)
    assert layout.colmap_folder() == ADJUSTED
    views = read_views(layout)
    scale = np.linalg.inv(Alignment.load(tmp_path / ALIGNMENT).shell_to_scene)
    straight = transformed(np.stack([view.camera.position.numpy() for view in views]), scale)
    assert np.linalg.norm(straight - CENTRES, axis=1).mean() < 0.015
    report = (tmp_path / "shell/report/index.html").read_text()
    assert "Cameras adjusted to the shell" in report
    assert all(view.name in report for view in views)
    table = report.partition("<h2>Cameras adjusted to the shell")[2].partition("<h2>")[0]
    moved = [float(moved) for moved in re.findall(r"<tr><td>[^<]*</td><td>([\d.]+) cm", table)]
    assert moved == sorted(moved, reverse=True)
    assert len(moved) == len(views)
    shown = [path.stem.rpartition("_")[2] for path in (tmp_path / "shell/report").glob("view_*.png")]
    assert len({*shown}) == len(shown) == 14
    assert {path: path.read_bytes() for path in (tmp_path / "colmap/sparse/0").iterdir()} == files

    with pytest.raises(SceneError, match="--refine would move the shell from where the cameras were adjusted to it"):
        align(tmp_path, AlignConfig(refine=0.1))
    assert "Motion that would fit the points better" not in report
    alignment = Alignment.load(tmp_path / ALIGNMENT)
    cast(tmp_path, views[:1], alignment, max_image_size=64)
    align(tmp_path, paths=ORIGINAL)
    assert Alignment.load(tmp_path / ALIGNMENT).model == ""
    assert layout.colmap_folder() == Path("colmap/sparse/0")
    view = read_views(layout)[0]
    with pytest.raises(SceneError, match="map"):
        CueMaps.open(tmp_path, "shell").require(view.name, view.camera.shrunk(64))


def test_a_scene_of_transforms_is_refused_in_a_sentence(scene: Path):
    before = (scene / ALIGNMENT).read_bytes()
    with pytest.raises(SceneError, match=r"transforms\.json has no tracks, which a COLMAP model has"):
        align(scene, AlignConfig(bundle_adjust=True))
    assert (scene / ALIGNMENT).read_bytes() == before
    assert not (scene / ADJUSTED).exists()


def test_the_command_leaves_straight_cameras_as_they_are(tmp_path: Path, model: Model):
    matrix = write(tmp_path, model, building(Layout(5, 3)))
    align(tmp_path, AlignConfig((tmp_path / "shell.ply",), matrix=matrix, bundle_adjust=True))
    assert "The cameras are left as they are" in (tmp_path / "shell/report/index.html").read_text()
    assert not (tmp_path / ADJUSTED).exists()
    assert ScenePaths().of(tmp_path).colmap_folder() == Path("colmap/sparse/0")


@pytest.mark.parametrize("wrong", ["30 cm", "2 degrees", "another building"])
def test_a_wrong_shell_does_not_bend_good_cameras(tmp_path: Path, model: Model, wrong: str):
    shift = np.eye(4)
    if wrong == "30 cm":
        shift[1, 3] = -0.3
    if wrong == "2 degrees":
        shift[:3, :3] = Rotation.from_euler("z", 2, degrees=True).as_matrix()
    mesh = building(Layout(3, 5) if wrong == "another building" else Layout(5, 3))
    matrix = write(tmp_path, model, mesh, shift)
    with suppress(SceneError):  # or says that the cameras are left as they are
        align(tmp_path, AlignConfig((tmp_path / "shell.ply",), matrix=matrix, bundle_adjust=True))
    assert not (tmp_path / ADJUSTED).exists()
    assert ScenePaths().of(tmp_path).colmap_folder() == Path("colmap/sparse/0")


def test_adjusted_cameras_that_are_missing_are_named(tmp_path: Path, model: Model):
    write(tmp_path, model, building(Layout(5, 3)))
    Alignment(np.eye(4), ("shell.ply",), model=ADJUSTED.as_posix()).save(tmp_path / ALIGNMENT)
    with pytest.raises(SceneError, match=r"colmap/adjusted, which is missing: align the shell again"):
        ScenePaths().of(tmp_path).colmap_folder()
