"""The report of an alignment, and the command: what it writes, and what becomes of it when inputs change."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
import torch
import trimesh
from alignments import TRUTH, displaced, shifted
from cameras import pinhole
from PIL import Image
from scenes import edited, views_of, write_colmap
from scipy.spatial.transform import Rotation

from shellgs_method.commands import cast as casting
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.scene import SceneLayout
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.geometry.similarity import transformed
from shellgs_method.occlusion import check, check_views
from shellgs_method.registration.align import PROPOSAL, REPORT
from shellgs_method.registration.report import shell_edges, write_report
from shellgs_method.registration.validation import validate
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh, load_shell
from shellgs_method.shell import alignment as alignment_module
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING
from shellgs_method.synthetic.scene import write_scan


def test_edges_are_at_outlines_steps_and_bends_but_not_on_a_slanted_plane():
    aside = pinhole(60, 64, 48, turn=Rotation.from_euler("y", 40, degrees=True).as_matrix())
    plane = ShellMesh(
        np.array([[-99.0, -99, 9], [99, -99, 9], [99, 99, 9], [-99, 99, 9]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    assert not shell_edges(ShellCaster(plane, np.eye(4)).cast(aside), 1.0).any()
    # A plate 10 cm in front of the plane, from -1 to 1: with a focal length of 60 and a depth of 9 it ends at 32 ± 6.7.
    corners = np.array([[-1.0, -1, 8.9], [1, -1, 8.9], [1, 1, 8.9], [-1, 1, 8.9]])
    both = ShellMesh(np.concatenate([plane.vertices, corners]), np.concatenate([plane.faces, plane.faces + 4]))
    edges = shell_edges(ShellCaster(both, np.eye(4)).cast(pinhole(60, 64, 48)), 1.0)
    assert set(np.flatnonzero(edges[24])) == {24, 25, 38, 39}


def test_a_crease_is_an_edge_and_the_noise_of_triangles_beside_it_is_not():
    # Two walls of 2 x 2 m that meet at a right angle in the middle of the image, in triangles of 4 cm, 3 pixels.
    u, v = np.meshgrid(np.linspace(-2, 2, 101), np.linspace(-2, 2, 101))
    noise = np.random.default_rng(0).normal(0, 0.01, u.shape)
    vertices = np.stack([u / np.sqrt(2), v, 8 - np.abs(u) / np.sqrt(2) + noise], axis=-1).reshape(-1, 3)
    corner = np.arange(101 * 100).reshape(100, 101)[:, :-1].ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 101], corner[:, None] + [1, 102, 101]])
    cue = ShellCaster(ShellMesh(vertices, faces), np.eye(4)).cast(pinhole(600, 160, 120))
    edges = shell_edges(cue, 1.0)
    neighbours = np.einsum("hwc,hwc->hw", cue.normal[:, 1:].astype(float), cue.normal[:, :-1].astype(float))
    beside = np.abs(np.arange(160) - 79.5) > 8
    assert (neighbours < np.cos(np.radians(25)))[:, beside[1:]].mean() > 0.1  # edges of a threshold alone
    assert edges[:, beside].mean() < 0.02
    assert edges[1:-1, 76:84].any(axis=1).mean() > 0.7


def test_a_matrix_is_validated_reported_and_written(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    shift = np.array([412_000.0, 5_123_000.0, 0.0])
    unshifted = true.shell_to_scene.copy()
    unshifted[:3, 3] += unshifted[:3, :3] @ shift  # for coordinates minus the shift, as CloudCompare has them
    (scene / "matrix.txt").write_text("\n".join(" ".join(f"{value:.12f}" for value in row) for row in unshifted))
    (scene / ALIGNMENT).unlink()
    shell = scene / true.shells[0]
    output = shellgs("align", scene, shell, "--matrix", scene / "matrix.txt", "--global-shift", *(-shift))
    assert "Verdict: good" in output or "Verdict: doubtful" in output
    written = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_allclose(
        written.apply(load_shell(shell).vertices), true.apply(load_shell(shell).vertices), atol=1e-4
    )
    assert written.verdict in output
    assert (written.metrics["within_10cm"] or 0) > 0.5
    page = (scene / REPORT / "index.html").read_text()
    assert f"Verdict: <b>{written.verdict}</b>" in page
    assert re.findall(r'(?:src|href)="(?!data:)', page) == []
    assert "http" not in page
    overlays = list((scene / REPORT).glob("view_*.png"))
    assert len(overlays) >= 6
    assert all(Image.open(overlay).size == (640, 427) for overlay in overlays)  # of photographs of 48 x 32
    assert json.loads((scene / REPORT / "validation.json").read_text())["verdict"] == written.verdict


FEET_UP = (1, 1, 1 / 0.3048)


def pick_corners(scene: Path, scaled: Sequence[float] = (1, 1, 1), moved: int = 0) -> Path:
    """Exact picks of the corners of openings, of a shell whose axes are scaled; the first ones are metres off."""
    corners = [(o.x0, 0.0, o.z0) for o in Layout(6, 3).openings] + [(o.x1, 0.0, o.z1) for o in Layout(6, 3).openings]
    building = np.array(corners)
    on_shell = transformed(building, SHELL_FROM_BUILDING) * scaled
    on_shell[:moved] += np.random.default_rng(0).normal(0, 3, (moved, 3))
    lines = []
    for view in views_of(scene):
        projection = (view.camera.K @ view.camera.viewmat[:3]).numpy()
        for k, point in enumerate(transformed(building, SCENE_FROM_BUILDING)):
            x, y, z = projection @ np.append(point, 1)
            if z > 0 and 0 < x / z < view.camera.width and 0 < y / z < view.camera.height:
                lines.append((k, f"{' '.join(map(str, on_shell[k]))} {x / z} {y / z} {view.name} p{k}"))
    seen = [k for k, _ in lines]
    picks = scene / "picks.txt"
    picks.write_text("\n".join(line for k, line in lines if seen.count(k) >= 4))
    return picks


def test_picks_of_which_less_than_half_agree_are_refused(scene, shellgs):
    shell = scene / Alignment.load(scene / ALIGNMENT).shells[0]
    said = shellgs("align", scene, shell, "--picks", pick_corners(scene, moved=28))
    assert re.search(r"refused: shellgs: only \d+ of 31 picks of .* agree .* as three may by chance", said)


def test_picks_of_a_shell_whose_heights_are_in_another_unit_are_refused(scene, shellgs, tmp_path):
    shell = load_shell(*Alignment.load(scene / ALIGNMENT).files(scene))
    trimesh.Trimesh(shell.vertices * FEET_UP, shell.faces, process=False).export(tmp_path / "feet.obj")
    said = shellgs("align", scene, tmp_path / "feet.obj", "--picks", pick_corners(scene, scaled=FEET_UP))
    assert re.search(r"refused: shellgs: only \d+ of 31 picks .*agree .* all axes of the shell in one unit\?", said)


def test_picks_and_refinement_give_the_alignment_and_residuals(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    picks = pick_corners(scene)
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--picks", picks, "--refine", 0.3)
    assert "picks are used" in output
    assert "Refined against" in output
    written = Alignment.load(scene / ALIGNMENT)
    vertices = load_shell(scene / true.shells[0]).vertices
    moved = np.linalg.norm(written.apply(vertices) - true.apply(vertices), axis=1).mean() * true.metres_per_unit
    assert moved < 0.05  # 300 SfM points, some of them on parts missing in the shell: flowers, railings, frames
    assert "Points known in both frames, worst first" in (scene / REPORT / "index.html").read_text()


def test_camera_positions_give_the_alignment_and_name_missing_photographs(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    lines = ["EPSG:25832", "IMG_0001.jpg 0 0 0"]
    for k, view in enumerate(views_of(scene)):
        position = transformed(view.camera.position.double().numpy(), np.linalg.inv(true.shell_to_scene))
        position[0] += 2.0 if k == 3 else 0.0
        lines.append(f"{Path(view.name).name} {' '.join(map(str, position))}")
    (scene / "geo.txt").write_text("\n".join(lines))
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--positions", scene / "geo.txt")
    assert "9 of 10 camera positions are used" in output
    assert "In geo.txt but not in the scene: IMG_0001.jpg" in output
    assert "left out" in output
    written = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_allclose(written.shell_to_scene, true.shell_to_scene, rtol=1e-6)
    assert written.source == "camera positions in geo.txt"
    assert "Points known in both frames, worst first" in (scene / REPORT / "index.html").read_text()


def test_a_refused_alignment_does_not_replace_the_saved_one(scene, shellgs):
    before = (scene / ALIGNMENT).read_bytes()
    true = Alignment.load(scene / ALIGNMENT)
    (scene / "off.json").write_text(json.dumps((true.shell_to_scene @ np.diag([1e3, 1e3, 1e3, 1])).tolist()))
    output = shellgs("align", scene, scene / true.shells[0], "--matrix", scene / "off.json")
    assert f"the alignment is refused, and {scene / ALIGNMENT} is unchanged" in " ".join(output.split())
    assert (scene / ALIGNMENT).read_bytes() == before
    assert "Verdict: <b>refused</b>" in (scene / REPORT / "index.html").read_text()
    (scene / ALIGNMENT).unlink()
    output = shellgs("align", scene, scene / true.shells[0], "--matrix", scene / "off.json")
    assert "the alignment is refused, and nothing is written: " in output
    assert not (scene / ALIGNMENT).exists()


def test_a_proposal_becomes_the_alignment_with_accept(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    assert not (scene / ALIGNMENT).exists()
    assert "Written" in shellgs("align", scene, "--accept")
    assert Alignment.load(scene / ALIGNMENT).places_like(Alignment.load(scene / PROPOSAL))


def test_validating_a_cast_alignment_writes_its_metrics_and_the_maps_error(scene, shellgs):
    before = Alignment.load(scene / ALIGNMENT)
    assert before.error is None
    assert "Written" in shellgs("align", scene)
    validated = Alignment.load(scene / ALIGNMENT)
    assert validated.verdict in ("good", "doubtful")
    assert validated.places_like(before)
    maps = CueMaps.open(scene, "shell")
    assert maps.manifest.error == validated.error is not None
    for view in views_of(scene):
        assert maps.read(view.name, view.camera) is not None
    assert "0 views cast, 10 already there" in shellgs("cast", scene)


def test_another_alignment_makes_the_maps_stale(scene, shellgs):
    moved = Alignment.load(scene / ALIGNMENT).shell_to_scene.copy()
    moved[0, 3] += 0.01
    np.save(scene / "matrix.npy", moved)
    assert "Written" in shellgs("align", scene, scene / "shell" / "facade.ply", "--matrix", scene / "matrix.npy")
    view = views_of(scene)[0]
    with pytest.raises(SceneError, match=r"shell/alignment.json has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


def move_cameras(scene: Path, motion: np.ndarray, digits: int = 17) -> None:
    """Apply a similarity to the scene's frame, as another run of structure from motion does."""
    with edited(scene / "transforms.json") as transforms:
        for frame in transforms["frames"]:
            pose = motion @ np.array(frame["transform_matrix"])
            pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
            frame["transform_matrix"] = [[float(f"{x:.{digits}g}") for x in row] for row in pose.tolist()]
    cloud = trimesh.load(scene / "sparse_pc.ply")
    cloud.apply_transform(motion).export(scene / "sparse_pc.ply")


ANOTHER_FRAME = displaced(2.0, 30.0, 0.5, seed=3)


def test_an_alignment_is_not_cast_for_other_cameras(scene, shellgs):
    move_cameras(scene, ANOTHER_FRAME)
    before = (scene / ALIGNMENT).read_bytes()
    refusal = shellgs("cast", scene, "--no-check")
    assert "was found for other cameras" in refusal
    assert f"run `shellgs align {scene}`" in refusal
    assert (scene / ALIGNMENT).read_bytes() == before


def change_shell(scene: Path) -> None:
    """Leave out one triangle of it."""
    mesh = shell(Layout(6, 3))
    write_scan(scene / "shell/facade.ply", replace(mesh, triangles=mesh.triangles[:-1]))


def run_of(scene: Path) -> TrainedRun:
    """A run of a scene, without a model."""
    views = views_of(scene)
    halves = [SimpleNamespace(views=views[:5]), SimpleNamespace(views=views[5:])]
    config = SimpleNamespace(dataparser=SimpleNamespace(data=scene))
    data: Any = SimpleNamespace(config=config, train_dataset=halves[0], eval_dataset=halves[1])
    model: Any = None
    return TrainedRun(model, data)


def test_a_run_is_not_exported_in_the_frame_of_other_cameras(scene):
    move_cameras(scene, ANOTHER_FRAME)
    with pytest.raises(SceneError, match="was found for other cameras"):
        _ = run_of(scene).shell


def test_a_shell_that_has_changed_is_used_once_it_is_validated_again(scene, shellgs):
    assert run_of(scene).shell is not None
    change_shell(scene)
    changed = r"shell/facade\.ply has changed since it was aligned: run `shellgs align"
    with pytest.raises(SceneError, match=changed):
        _ = run_of(scene).shell
    assert re.search(changed, shellgs("cast", scene))
    maps, view = CueMaps.open(scene, "shell"), views_of(scene)[0]
    first = r"facade\.ply has changed since; run `shellgs cast"
    with pytest.raises(SceneError, match=first):
        maps.read(view.name, view.camera)
    assert "facade.ply has changed since it was aligned" in shellgs("align", scene)
    assert run_of(scene).shell is not None
    with pytest.raises(SceneError, match=r"facade\.ply has changed since; run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)
    assert "views cast" in shellgs("cast", scene)


def test_a_project_that_was_moved_keeps_its_shell_and_its_maps(scene, shellgs, tmp_path):
    shells, known = {name: tmp_path / name / "scans/facade.ply" for name in "ab"}, Alignment.load(scene / ALIGNMENT)
    shells["a"].parent.mkdir(parents=True)
    (scene / known.shells[0]).rename(shells["a"])
    scene = scene.rename(tmp_path / "a/scene")
    replace(known, shells=(str(shells["a"]),)).record(scene / ALIGNMENT, views_of(scene))
    assert "10 views cast" in shellgs("cast", scene)
    made = [CueMaps.open(scene, kind).manifest for kind in ("shell", "checked")]
    scene = (tmp_path / "a").rename(tmp_path / "b") / "scene"
    assert Alignment.load(scene / ALIGNMENT).files(scene) == [shells["b"]]
    assert "0 views cast, 10 already there" in shellgs("cast", scene)
    assert [CueMaps.open(scene, kind).manifest for kind in ("shell", "checked")] == made
    shells["b"].write_text("another scan")
    assert Alignment.load(scene / ALIGNMENT).files(scene) == [shells["a"]]


def test_an_alignment_of_an_older_version_knows_no_hashes_and_is_used(scene):
    with edited(scene / ALIGNMENT) as fields:
        del fields["hashes"]
    (scene / "shell/facade.ply").touch()
    assert run_of(scene).shell is not None


def test_a_gltf_has_changed_if_the_file_of_its_vertices_has(tmp_path):
    trimesh.Scene(trimesh.creation.box()).export(tmp_path / "a.gltf")
    bound = Alignment(np.eye(4), ("a.gltf",)).bound(tmp_path, [])
    assert bound.changed_file(tmp_path) is None
    buffer = max(tmp_path.glob("*.bin"), key=lambda file: file.stat().st_size)
    buffer.write_bytes(buffer.read_bytes()[::-1])
    assert bound.changed_file(tmp_path) == tmp_path / "a.gltf"
    assert not bound.places_like(bound.bound(tmp_path, []))


def test_hashes_that_are_edited_by_hand_are_read_or_refused_with_a_remedy(scene):
    def edit(hashes: Any) -> Alignment:
        fields = json.loads((scene / ALIGNMENT).read_text())
        (scene / ALIGNMENT).write_text(json.dumps(fields | {"hashes": hashes}))
        return Alignment.load(scene / ALIGNMENT)

    known = Alignment.load(scene / ALIGNMENT).hashes
    assert edit(known[0].upper()).hashes == known
    with pytest.raises(SceneError, match=r"alignment\.json: .* has 2 hashes of 1 files: align the shell again"):
        edit([*known, *known])


def test_a_proposal_for_a_shell_that_has_changed_is_not_accepted(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    change_shell(scene)
    assert "facade.ply has changed since" in shellgs("align", scene, "--accept")
    assert not (scene / ALIGNMENT).exists()


def test_an_alignment_that_fits_other_cameras_too_is_validated_for_them(scene, shellgs):
    move_cameras(scene, displaced(0.02, 0.0, 0.0, seed=3))
    output = shellgs("align", scene)
    assert "It was found for other cameras than these" in output
    assert "Written" in output
    assert Alignment.load(scene / ALIGNMENT).cameras.changed(views_of(scene)) is None


def test_a_proposal_for_other_cameras_is_not_accepted(scene, shellgs):
    (scene / ALIGNMENT).rename(scene / PROPOSAL)
    move_cameras(scene, ANOTHER_FRAME)
    assert "was proposed for other cameras" in shellgs("align", scene, "--accept")


def test_photographs_come_and_go_without_harm_to_the_alignment(scene):
    found = Alignment.load(scene / ALIGNMENT)
    views = views_of(scene)
    added = replace(views[0], name="images/new.png", camera=replace(views[0].camera, width=7))
    assert found.cameras.changed([*views[3:], added]) is None
    assert found.cameras.changed(views[4:5]) is None
    assert "of their 10 photographs, 1 are in the scene" in (found.cameras.changed([views[0], added]) or "")


def test_photographs_in_another_folder_are_the_same(views):
    before = BoundCameras.of(views)
    smaller = [
        replace(view, name=view.name.replace("images/", "images_2/"), camera=view.camera.resized(32, 24))
        for view in views
    ]
    assert before.changed(smaller) is None
    smaller[3] = replace(smaller[3], camera=smaller[4].camera)
    assert "stood" in (before.changed(smaller) or "")
    converted = [replace(view, name=view.name.replace(".png", ".heic")) for view in views]
    assert {view.name for view in converted}.isdisjoint(before.cameras)
    assert before.changed(converted) is None
    by_drones = [replace(view, name=f"drone_{k % 2}/{k // 2}.jpg") for k, view in enumerate(views)]
    assert "0 are in the scene" in (BoundCameras.of(by_drones).changed([replace(views[0], name="2/0.jpg")]) or "")


@pytest.mark.parametrize("digits", [6, 8])
def test_cameras_printed_again_are_the_same(scene, digits):
    move_cameras(scene, np.eye(4), digits)
    assert Alignment.load(scene / ALIGNMENT).cameras.changed(views_of(scene)) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: replace(c, viewmat=c.viewmat + torch.tensor([0, 0, 0, 0.1])[:, None].T), "scene units away"),
        (lambda c: replace(c, viewmat=torch.from_numpy(displaced(0, 1, 0, 3)) @ c.viewmat), "turned by 1°"),
        (lambda c: replace(c, K=c.K * torch.tensor([1.01, 1.01, 1])[:, None]), "differ by"),
    ],
    ids=["position", "rotation", "intrinsics"],
)
def test_a_camera_that_changed_is_named(views, change, words):
    before = BoundCameras.from_json(json.loads(json.dumps(BoundCameras.of(views).to_json())))
    assert before.changed([replace(view, camera=view.camera.resized(48, 32)) for view in views]) is None
    changed = [*views[:4], replace(views[4], camera=change(views[4].camera)), *views[5:]]
    assert re.search(f"{views[4].name}.* {words}", before.changed(changed) or "")


def test_an_alignment_of_an_older_version_is_cast_and_says_so(scene, shellgs):
    with edited(scene / ALIGNMENT) as fields:
        del fields["cameras"]
    scene = scene.rename(scene.with_name("my scene"))
    told = shellgs("cast", scene, "--no-check")
    assert f"does not say which cameras it was found for: `shellgs align '{scene}'` records them" in told
    assert "Written" in shellgs("align", scene)
    assert "does not say" not in shellgs("cast", scene, "--no-check")


@pytest.fixture
def scanned(scene: Path) -> Path:
    """The scene with a point cloud as its shell, sparse enough for fast meshing."""
    alignment = Alignment.load(scene / ALIGNMENT)
    samples, _ = ShellSurface(load_shell(scene / alignment.shells[0])).samples(4000)
    survey = ShellSurface(load_shell(scene / alignment.shells[0])).survey_from_shell
    np.savetxt(scene / "shell" / "scan.xyz", transformed(samples, np.linalg.inv(survey)), fmt="%.4f")
    np.save(scene / "matrix.npy", alignment.shell_to_scene)
    return scene


def test_holes_in_the_mesh_of_a_scan_are_told(scanned, shellgs, monkeypatch):
    monkeypatch.setattr(casting, "HOLES", -1.0)
    command = ("cast", scanned, "--shell", scanned / "shell/scan.xyz", "--matrix", scanned / "matrix.npy", "--no-check")
    told = " ".join(shellgs(*command).split())
    assert "far behind, through holes of a few pixels in the mesh" in told
    assert "--mesher poisson` closes most" in told
    assert "a denser scan is needed" in " ".join(shellgs(*command, "--mesher", "poisson").split())


def test_the_mesher_belongs_to_the_alignment(scanned, shellgs, monkeypatch):
    """The validated mesh is cast and loaded; another mesher removes the verdict."""
    used: list[str] = []
    load = alignment_module.load_shell
    monkeypatch.setattr(
        alignment_module, "load_shell", lambda *args, **named: used.append(named["mesher"]) or load(*args, **named)
    )
    shell = scanned / "shell" / "scan.xyz"
    shellgs("align", scanned, shell, "--matrix", scanned / "matrix.npy", "--mesher", "bpa")
    validated = Alignment.load(scanned / ALIGNMENT)
    assert (validated.mesher, bool(validated.verdict)) == ("bpa", True)
    assert "10 views cast" in shellgs("cast", scanned)
    validated.load_shell(scanned, views_of(scanned))
    assert set(used) == {"bpa"}
    assert "validated with another mesher" in shellgs("cast", scanned, "--mesher", "planes")
    assert Alignment.load(scanned / ALIGNMENT) == replace(validated, mesher="planes", verdict="", metrics={})


def test_a_cloud_is_meshed_again_once_its_cameras_are_known(scanned):
    """A proposal's mesh, made without viewpoints, is not the one that is cast."""
    shell, cache = scanned / "shell" / "scan.xyz", scanned / "shell"
    views = views_of(scanned)
    alignment = Alignment(np.load(scanned / "matrix.npy"), ("shell/scan.xyz",))
    load_shell(shell, cache=cache)
    guessed = (cache / "scan.xyz.planes.ply").read_bytes()
    alignment.load_shell(scanned, views)
    seen = (cache / "scan.xyz.planes.ply").read_bytes()
    assert seen != guessed
    nearby = replace(alignment, shell_to_scene=shifted(right=0.3).shell_to_scene)
    nearby.load_shell(scanned, views)
    assert (cache / "scan.xyz.planes.ply").read_bytes() == seen
    behind = replace(alignment, shell_to_scene=shifted(out=40.0).shell_to_scene)
    behind.load_shell(scanned, views)
    assert (cache / "scan.xyz.planes.ply").read_bytes() != seen


def test_chosen_folders_reach_every_command(scene, shellgs):
    """Photographs and cameras in folders of other names, which the maps' manifest names too."""
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    cloud = trimesh.load(scene / "sparse_pc.ply")
    lines = [
        f"{k} {x} {y} {z} 9 9 9 0.1 {k % 10 + 1} 0"
        for k, (x, y, z) in enumerate(cloud.vertices.tolist())  # pyright: ignore[reportAttributeAccessIssue]
    ]
    (scene / "sparse" / "0" / "points3D.txt").write_text("\n".join(lines))
    (scene / "sparse" / "0").rename(scene / "model")
    (scene / "sparse").rmdir()
    (scene / "images").rename(scene / "photos")
    paths = ("--images-path", "photos", "--colmap-path", "model")
    assert "holds no cameras" in shellgs("align", scene)
    assert "Written" in shellgs("align", scene, *paths)
    assert "10 views cast" in shellgs("cast", scene, *paths)
    command = CueMaps.open(scene, "shell").manifest.command
    assert command == "shellgs cast {scene} --images-path photos --colmap-path model"
    printed = shellgs("mono", scene, *paths, "from", scene / "predictions")
    assert "maps made" in printed or "no view has a monocular map that can be trusted" in printed


@pytest.mark.parametrize(
    "words", [["--matrix", "m.txt"], ["shell.ply", "--matrix", "m", "--picks", "p"], ["--positions", "g"]]
)
def test_starts_that_contradict_each_other_are_refused(scene, shellgs, words):
    assert "give a shell, alone or with one of --matrix" in shellgs("align", scene, *words)


@pytest.mark.parametrize("words", [["--global-shift", 1, 2, 3], ["--metres-per-shell-unit", 0.001]])
@pytest.mark.parametrize("command", ["align", "cast"])
def test_settings_of_a_matrix_are_refused_without_it(scene, shellgs, command, words):
    before = (scene / ALIGNMENT).read_bytes()
    assert re.match(f"refused: .*{words[0]}.* (give|go with)", shellgs(command, scene, *words))
    assert (scene / ALIGNMENT).read_bytes() == before


def test_a_global_shift_is_cast(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    shift = np.eye(4)
    shift[:3, 3] = [-412_000.0, -5_123_000.0, 0.0]
    np.save(scene / "matrix.npy", true.shell_to_scene @ np.linalg.inv(shift))
    words = ("--shell", scene / true.shells[0], "--matrix", scene / "matrix.npy", "--global-shift", *shift[:3, 3])
    shellgs("cast", scene, *words, "--no-check")
    np.testing.assert_allclose(Alignment.load(scene / ALIGNMENT).shell_to_scene, true.shell_to_scene, atol=1e-6)


def test_a_matrix_is_of_the_unit_and_system_of_the_shell_for_cast_as_for_align(scene, shellgs, tmp_path, caplog):
    true, foot = Alignment.load(scene / ALIGNMENT), 1200 / 3937
    mesh, size = load_shell(*true.files(scene)), CueMaps.open(scene, "shell").manifest.metres_per_unit
    middle = mesh.vertices.mean(axis=0)
    to_feet = np.diag([1 / foot, 1 / foot, 1 / foot, 1])
    to_feet[:3, 3] = [980_000, 200_000, 50] - middle / foot
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in transformed(mesh.vertices, to_feet)]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    (tmp_path / "feet.obj").write_text("\n".join(lines) + "\n")
    (tmp_path / "feet.prj").write_text(pyproj.CRS("EPSG:2263").to_wkt("WKT1_ESRI"))
    np.save(tmp_path / "matrix.npy", true.shell_to_scene @ np.linalg.inv(to_feet))
    placed = "--matrix", tmp_path / "matrix.npy"
    (scene / ALIGNMENT).unlink()
    shellgs("cast", scene, "--shell", tmp_path / "feet.obj", *placed, "--no-check")
    cast_there = Alignment.load(scene / ALIGNMENT)
    assert "is in US survey foot: its unit is taken as 0.30480061 m" in caplog.text
    assert cast_there.metres_per_shell_unit == pytest.approx(foot)
    assert CueMaps.open(scene, "shell").manifest.metres_per_unit == pytest.approx(size)
    assert "Long_Island" in cast_there.crs or cast_there.crs == "EPSG:2263"
    (scene / ALIGNMENT).unlink()
    shellgs("align", scene, tmp_path / "feet.obj", *placed)
    aligned = Alignment.load(scene / ALIGNMENT)
    assert cast_there.places_like(aligned)
    assert cast_there.crs == aligned.crs
    before = (scene / ALIGNMENT).read_bytes()
    for flag in ("--shell", "--truth"):
        told = shellgs("cast", scene, flag, tmp_path / "feet.obj", *placed, "--crs", "EPSG:3857")
        assert re.match("refused: .*is a projection of the whole Earth", told)
    assert (scene / ALIGNMENT).read_bytes() == before


def test_a_matrix_to_the_frame_that_an_applied_transform_leads_to_is_told(scene, shellgs, tmp_path):
    true, path = Alignment.load(scene / ALIGNMENT), scene / "transforms.json"
    (scene / ALIGNMENT).unlink()
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    path.write_text(json.dumps(json.loads(path.read_text()) | {"applied_transform": applied[:3].tolist()}))
    placed, why = ("--matrix", tmp_path / "matrix.npy"), "multiply it from the left by the inverse of that"
    np.save(tmp_path / "matrix.npy", true.shell_to_scene)  # as the poses and points of the file show it
    assert re.match(f"refused: .*the alignment is refused.*{why}", shellgs("align", scene, *true.files(scene), *placed))
    told = shellgs("cast", scene, "--shell", *true.files(scene), *placed, "--no-check")
    assert "Hardly any pixel shows the shell" in told
    assert why in told
    np.save(tmp_path / "matrix.npy", np.linalg.inv(applied) @ true.shell_to_scene)
    told = shellgs("cast", scene, "--shell", *true.files(scene), *placed, "--no-check")
    assert "Hardly any pixel" not in told
    assert re.search(r"covers [5-9]\d% of their pixels", told)


def test_an_alignment_without_a_verdict_is_read(tmp_path):
    fields = {"shell_to_scene": np.eye(4).tolist(), "shell": "a.ply", "metres_per_shell_unit": 1.0, "source": "matrix"}
    (tmp_path / "alignment.json").write_text(json.dumps(fields))
    assert Alignment.load(tmp_path / "alignment.json") == Alignment(np.eye(4), ("a.ply",))
    validated = Alignment(np.eye(4), ("a.ply",), verdict="good", metrics={"bias_m": 0.01, "pull_m": None})
    validated.save(tmp_path / "alignment.json")
    assert Alignment.load(tmp_path / "alignment.json") == validated


def test_a_report_is_written_even_if_no_camera_sees_the_shell(mesh, views, points, tmp_path):
    validation = validate(mesh, Alignment(displaced(1e4, 0, 0, 1) @ TRUTH, ("<shell>.ply",)), views, points)
    page = write_report(tmp_path / "report", mesh, validation).read_text()
    assert "&lt;shell&gt;.ply: refused" in page


def test_a_photograph_of_another_shape_is_refused_by_the_size_of_its_camera(scene, tmp_path, monkeypatch):
    views, points = views_of(scene), read_sparse_points(SceneLayout(data=scene))
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh = load_shell(*alignment.files(scene))
    validation = validate(mesh, alignment, views, points)
    monkeypatch.setattr(check, "MAX_SIZE", 24)
    for view in views:
        Image.open(view.image).resize((48, 48)).save(view.image)
    refused = "is 48x48 pixels, but its camera is 48x32"
    with pytest.raises(SceneError, match=refused):
        write_report(tmp_path / "report", mesh, validation)
    with pytest.raises(SceneError, match=refused):
        check_views(scene, views, set(), points)


def test_a_shell_in_the_frame_of_the_cameras_needs_no_matrix_and_its_system_is_kept(scene, shellgs, tmp_path):
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh = load_shell(*alignment.files(scene))
    placed = trimesh.Trimesh(alignment.apply(mesh.vertices), mesh.faces, process=False)
    placed.export(tmp_path / "placed.ply")
    words = (
        "align",
        scene,
        tmp_path / "placed.ply",
        "--same-frame",
        "--metres-per-shell-unit",
        alignment.metres_per_unit,
    )
    told = shellgs(*words, "--crs", "EPSG:28991")  # whose origin is in its area
    assert "Verdict: doubtful" in told  # its coordinates are in single precision
    found = Alignment.load(scene / ALIGNMENT)
    np.testing.assert_array_equal(found.shell_to_scene, np.eye(4))
    assert found.crs == "EPSG:28991"
    for again in (("align", scene), words):  # validated, and aligned
        shellgs(*again)
        assert Alignment.load(scene / ALIGNMENT).crs == "EPSG:28991"
    elsewhere = trimesh.Trimesh(placed.vertices + 1e5, placed.faces, process=False)
    elsewhere.export(tmp_path / "elsewhere.ply")
    assert "a shift" in shellgs("align", scene, tmp_path / "elsewhere.ply", "--same-frame")
