"""A shell of several files in one frame, from loading to simulation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from building_models import NATIONAL, Face, cityjson, house, ifc_house, moved, save_json
from scenes import views_of
from training_runs import trainer_of

from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, ShellMesh, load_shell
from shellgs_method.sim.settings import SimSettings


def ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """Write a PLY of doubles, in text."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(repr, vertex)) for vertex in vertices.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def block(path: Path, x: float = 0.0, width: float = 5.0, shift: np.ndarray = NATIONAL) -> Path:
    """A block beside the house."""
    box = trimesh.creation.box(bounds=[[x, 0, 0], [x + width, width, width]])
    return ply(path, np.asarray(box.vertices) + shift, np.asarray(box.faces))


def wall(path: Path, x: float) -> Path:
    """A point cloud of a wall."""
    u, v = np.meshgrid(np.linspace(0, 3, 40), np.linspace(0, 3, 40))
    rough = np.random.default_rng(0).normal(0, 0.002, u.size)
    points = np.stack([x + u.ravel(), rough, v.ravel()], axis=1) + NATIONAL
    np.savetxt(path, points, fmt="%.6f")
    return path


def corners(mesh: ShellMesh, chosen: np.ndarray) -> np.ndarray:
    return mesh.vertices[mesh.faces[chosen]]


def test_meshes_models_and_clouds_are_one_shell_that_knows_their_files(tmp_path: Path):
    paths = [
        block(tmp_path / "left.ply", -8),
        save_json(tmp_path / "house.city.json", cityjson(house())),
        ifc_house(site=NATIONAL + np.array([10, 0, 0])).save(tmp_path / "right.ifc"),
        wall(tmp_path / "scan.xyz", 18),
    ]
    whole = load_shell(*paths)
    for number, path in enumerate(paths):
        alone, there = load_shell(path), whole.source == number
        np.testing.assert_allclose(corners(whole, there), corners(alone, np.ones(len(alone.faces), bool)))
        np.testing.assert_array_equal(whole.classes[there], alone.classes)
    assert len({*whole.source}) == 4
    assert {SurfaceClass.WINDOW, SurfaceClass.OTHER} <= {*map(SurfaceClass, whole.classes)}
    (meshing,) = whole.meshing
    assert meshing.points == 1600


def test_clouds_of_one_name_have_meshes_of_their_own(tmp_path: Path):
    paths = [tmp_path / name / "scan.xyz" for name in ("left", "right")]
    for x, path in enumerate(paths):
        path.parent.mkdir()
        wall(path, 4.0 * x)
    first, again = (load_shell(*paths, cache=tmp_path) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert np.ptp(first.vertices[:, 0]) == pytest.approx(7, abs=1e-3)
    assert len([*tmp_path.rglob("scan.xyz.planes.ply")]) == 2


def test_a_file_given_twice_is_refused(tmp_path: Path):
    one, copy = block(tmp_path / "a.ply"), block(tmp_path / "b.ply")
    with pytest.raises(SceneError, match=r"a\.ply is given twice: give each"):
        load_shell(one, tmp_path / ".." / tmp_path.name / "a.ply")
    with pytest.raises(SceneError, match=r"b\.ply is a copy of .*a\.ply: give each"):
        load_shell(one, copy)


def test_a_file_in_another_frame_is_refused_by_name(tmp_path: Path):
    paths = [block(tmp_path / f"{x}.ply", x) for x in (0, 6, 12)]
    local = block(tmp_path / "local.ply", shift=np.zeros(3))
    with pytest.raises(SceneError, match=r"local\.ply and .* are 5.43e\+03 km apart, and cannot be one shell: export"):
        load_shell(paths[0], local, *paths[1:])


def test_a_file_that_stands_alone_or_is_of_another_size_is_told(tmp_path: Path, caplog):
    load_shell(block(tmp_path / "a.ply"), block(tmp_path / "b.ply", 6), block(tmp_path / "c.ply", 30, 1))
    assert "c.ply stands alone, 19 m from" in caplog.text
    caplog.clear()
    load_shell(block(tmp_path / "a.ply"), block(tmp_path / "mm.ply", -100, 5000))
    assert "mm.ply is 1000 times as large as" in caplog.text
    caplog.clear()
    load_shell(block(tmp_path / "a.ply"), block(tmp_path / "b.ply", 6))
    assert not caplog.text


def split(scene: Path) -> list[Path]:
    """The scene's shell as two files: a mesh of what is left, and a CityJSON of what is right."""
    mesh = load_shell(scene / "shell" / "facade.ply")
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    along = centres @ np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2][0]
    left = along < np.median(along)
    faces = moved([Face([corners], "WallSurface") for corners in mesh.vertices[mesh.faces[~left]]], -NATIONAL)
    model = save_json(scene / "shell" / "right.json", cityjson(faces))
    return [ply(scene / "shell" / "left.ply", mesh.vertices, mesh.faces[left]), model]


def test_two_files_go_through_all_commands(scene: Path, tmp_path: Path, shellgs, monkeypatch, capsys):
    """Aligned by the matrix of the whole, they are cast like it, and a simulation knows them."""
    from shellgs_method.sim import simulate

    asked = []
    find = simulate.find_deviations
    monkeypatch.setattr(simulate, "find_deviations", lambda *args, **of: asked.append(of) or find(*args, **of))
    true, files = Alignment.load(scene / ALIGNMENT), split(scene)
    views = views_of(scene)
    whole = ShellCaster(load_shell(scene / true.shells[0]), true.shell_to_scene)
    np.save(scene / "matrix.npy", true.shell_to_scene)
    said = shellgs("align", scene, *files, "--matrix", scene / "matrix.npy")
    assert "Verdict: good" in said or "Verdict: doubtful" in said
    names = ["shell/left.ply", "shell/right.json"]
    assert json.loads((scene / ALIGNMENT).read_text())["shell"] == names
    assert "10 views cast" in shellgs("cast", scene)
    maps = CueMaps.open(scene, "shell")
    assert {*names} <= {*maps.manifest.sources}
    for view in views:
        cue, expected = maps.require(view.name, view.camera), whole.cast(view.camera)
        assert (cue.mask != expected.mask).mean() < 0.01
        both = cue.mask & expected.mask
        off = np.abs(cue.depth - expected.depth)[both] * true.metres_per_unit
        assert np.quantile(off, 0.95) < 0.002  # coordinates in steps of a millimetre, seen at a grazing angle
    trainer = trainer_of(scene, tmp_path / "run", "shellgs_metric", iterations=5)
    trainer.train()
    trainer.save_checkpoint(5)
    trainer.config.save_config()
    cli.sim((trainer.base_dir / "config.yml", tmp_path / "sim"), SimSettings(faces=4000))
    done = [line.removesuffix(" ...") for line in capsys.readouterr().out.splitlines() if line.endswith(" ...")]
    assert done.index("Loading the run") < done.index("Baking the texture") < len(done) - 1
    assert (tmp_path / "sim" / "report.html").is_file()
    assert "throws" not in json.loads((tmp_path / "sim" / "metrics.json").read_text())  # only with --test
    (of,) = asked
    assert list(of["files"]) == names
    np.testing.assert_array_equal(of["sources"], load_shell(*files).source)

    files[1].write_text(files[1].read_text() + " ")
    assert "right.json has changed since it was aligned" in shellgs("cast", scene)
    shellgs("align", scene)
    assert "10 views cast, 0 already there" in shellgs("cast", scene, "--no-check")


def test_picks_may_be_on_any_of_the_files(scene: Path, shellgs):
    files, true = split(scene), Alignment.load(scene / ALIGNMENT)
    mesh, views = load_shell(*files), views_of(scene)
    places = np.concatenate([corners(mesh, mesh.source == file).reshape(-1, 3)[::97][:8] for file in range(2)])
    picks: dict[int, list[str]] = {}
    for view in views:
        inside, pixels, _ = in_view(view.camera, true.apply(places))
        for k, pixel in zip(np.flatnonzero(inside), pixels, strict=True):
            line = [*map(repr, places[k].tolist()), *map(str, pixel), Path(view.name).name, f"p{k}"]
            picks.setdefault(int(k), []).append(" ".join(line))
    (scene / "picks.txt").write_text("\n".join(line for lines in picks.values() if len(lines) > 2 for line in lines))
    said = shellgs("align", scene, *files, "--picks", scene / "picks.txt")
    assert "Verdict: good" in said or "Verdict: doubtful" in said
    found = Alignment.load(scene / ALIGNMENT)
    assert found.shells == ("shell/left.ply", "shell/right.json")
    np.testing.assert_allclose(found.apply(mesh.vertices), true.apply(mesh.vertices), atol=0.02)


def test_an_ifc_model_is_read_once(tmp_path: Path, monkeypatch):
    path = ifc_house().save(tmp_path / "a.ifc")
    first = load_shell(path, cache=tmp_path)
    with monkeypatch.context() as patched:
        patched.delattr("shellgs_method.shell.loading.read_surface")
        again = load_shell(path, cache=tmp_path)
    for name in ("vertices", "faces", "classes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert again.step.coarsest == first.step.coarsest
    (tmp_path / "a.ifc.npz").write_bytes((tmp_path / "a.ifc.npz").read_bytes()[:500])
    np.testing.assert_array_equal(load_shell(path, cache=tmp_path).vertices, first.vertices)
    ifc_house(site=[100, 0, 0]).save(path)
    moved_by = load_shell(path, cache=tmp_path).vertices - first.vertices
    np.testing.assert_allclose(moved_by, np.broadcast_to([100, 0, 0], moved_by.shape), atol=1e-9)
