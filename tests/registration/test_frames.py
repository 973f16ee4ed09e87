"""Points that are not in the frame of what they belong to are refused, with the slip that explains it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scenes import edited, views_of
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.errors import SceneError
from shellgs_method.files import colmap
from shellgs_method.files.photographs import View, some_small
from shellgs_method.files.sparse_points import SparsePoints, find_sparse_points
from shellgs_method.files.undistortion import distort_pixels
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.lens import Lens
from shellgs_method.registration import sfm_frame
from shellgs_method.registration.frames import ShellPlace, apart, heights_apart
from shellgs_method.registration.sfm_frame import _Sight
from shellgs_method.registration.slips import in_degrees, slips
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell

MILLIMETRES = "are in millimetres instead of metres"


@pytest.fixture(scope="module")
def views(pristine_scene: Path) -> list[View]:
    return views_of(pristine_scene)


@pytest.fixture(scope="module")
def points(pristine_scene: Path) -> SparsePoints:
    return find_sparse_points(FacadeDataParserConfig(data=pristine_scene))


def check_points(points: SparsePoints, views: list[View]) -> None:
    sfm_frame.check_points(points, views, some_small(views))


def other(points: SparsePoints, change: np.ndarray) -> SparsePoints:
    return replace(points, positions=points.positions @ change.T)


# Points and cameras


def test_points_in_the_frame_of_the_cameras_are_accepted_in_silence(points, views, caplog):
    check_points(points, views)
    grey = replace(points, colours=np.full_like(points.colours, 128))
    check_points(grey, views)
    assert not caplog.records


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.diag([1, -1, -1]), "they have OpenGL's axes instead of OpenCV's"),
        (np.diag([1, 1, -1]), "they have other axes: as x y -z they fit"),
        (np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), "they have z up instead of y"),
        (np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), "they have other axes: as y x -z they fit"),
        (np.diag([1e3] * 3), f"they {MILLIMETRES}"),
        (np.diag([0.3048] * 3), "they are in metres instead of feet"),
        (np.diag([10] * 3), "they are ten times too large"),
    ],
    ids=["OpenGL", "mirrored", "COLMAP and nerfstudio", "an old applied_transform", "millimetres", "feet", "tenfold"],
)
def test_points_with_other_axes_or_in_another_unit_are_refused_with_the_slip(points, views, change, words):
    with pytest.raises(SceneError, match=f"not in the frame of the cameras: {words}"):
        check_points(other(points, change), views)


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
AHEAD_LEFT_UP = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # in OpenGL's axes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda matrix: matrix @ OPENGL, "has OpenCV's axes of the camera instead of OpenGL's: negate"),
        (np.linalg.inv, "is from the world to the camera: invert it"),
        (lambda matrix: np.linalg.inv(matrix @ OPENGL), "in OpenCV's axes: invert it, and negate"),
        (lambda matrix: matrix @ np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "rolled by 90°"),
        (lambda matrix: matrix @ np.diag([-1.0, -1, 1, 1]), "rolled by 180°"),
        (lambda matrix: matrix @ AHEAD_LEFT_UP, "has a vehicle's axes .* replace its first three columns"),
    ],
    ids=["OpenCV", "inverse", "OpenCV inverse", "quarter", "half", "vehicle"],
)
def test_poses_of_another_convention_are_refused_with_the_slip(scene, change, words):
    with edited(scene / "transforms.json") as transforms:
        for frame in transforms["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    layout = FacadeDataParserConfig(data=scene)
    with pytest.raises(SceneError, match=f"the cameras do not see the SfM points .*: .*{words}"):
        check_points(find_sparse_points(layout), read_views(layout))


@pytest.mark.parametrize("tracks", ["keypoints", "tracks", "colours"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.linalg.inv, "are those of the cameras, .* invert them"),
        (lambda viewmat: OPENGL @ viewmat, "have OpenGL's axes of the camera instead of OpenCV's"),
        (lambda viewmat: written_scalar_last(viewmat), "are in the order x y z w"),
        (lambda viewmat: AHEAD_LEFT_UP.T @ OPENGL @ viewmat, "have a vehicle's axes .* replace the rows"),
    ],
    ids=["inverse", "OpenGL", "x y z w", "vehicle"],
)
def test_poses_of_another_convention_in_a_colmap_model_are_refused(points, views, change, words, tracks):
    known = tracked(points, views)
    of_model = {
        "keypoints": known,
        "tracks": replace(known, features={}),
        "colours": replace(known, features={}, observed=None),
    }[tracks]
    wrong = [
        replace(v, camera=replace(v.camera, viewmat=torch.from_numpy(change(v.camera.viewmat.numpy())))) for v in views
    ]
    check_points(of_model, views)
    with pytest.raises(SceneError, match=f"the cameras do not see the SfM points of sparse/0 .*{words}"):
        check_points(of_model, wrong)


def test_points_of_a_model_with_tracks_in_another_unit_are_refused(points, views):
    known = tracked(points, views)
    with pytest.raises(SceneError, match="not in the frame of the cameras: perhaps they are in metres instead of feet"):
        check_points(other(known, np.diag([0.3048] * 3)), views)


def tracked(points: SparsePoints, views: list[View], size: float = 1.0) -> SparsePoints:
    """The points with their tracks, whose keypoints are of photographs of that size relative to the cameras'."""
    shown = {view.name: in_view(view.camera, points.positions) for view in views}
    sizes = {view.name: [view.camera.width, view.camera.height] for view in views}
    return replace(
        points,
        called="the SfM points of sparse/0",
        observed={name: np.flatnonzero(inside) for name, (inside, _, _) in shown.items()},
        features={name: size * pixels / sizes[name] for name, (_, pixels, _) in shown.items()},
    )


def test_points_at_their_keypoints_are_accepted_in_silence(points, views, caplog):
    lens = Lens(views[0].camera.K, views[0].camera.width, views[0].camera.height, (0.3, 0, 0, 0, 0, 0))
    K = lens.K.double().numpy()
    bent = tracked(points, views)
    size = [lens.width, lens.height]
    bent = replace(
        bent, colours=None, features={k: distort_pixels(lens, f * size, K) / size for k, f in bent.features.items()}
    )
    for known, seen in (
        (tracked(points, views), views),
        (tracked(points, views), [replace(v, camera=v.camera.shrunk(20)) for v in views]),
        (tracked(points, views, size=4.0), views),
        (bent, [replace(view, lens=lens) for view in views]),
    ):
        check_points(known, seen)
    assert bent.observed is not None
    unseen = replace(bent, observed={**bent.observed, views[0].name: np.empty(0, int)})
    unseen = replace(unseen, features={**bent.features, views[0].name: np.empty((0, 2))})
    for of in (lens, replace(lens, fisheye=True)):
        check_points(unseen, [replace(views[0], lens=of), *(replace(view, lens=lens) for view in views[1:])])
    assert not caplog.records
    check_points(bent, views)
    assert "not where their own keypoints show them, but" in caplog.text


@pytest.mark.parametrize(
    "shown",
    ["poses in another order", "a focal length of another lens", "keypoints of a script", "numbers of other keypoints"],
)
def test_a_model_whose_tracks_contradict_its_cameras_is_told(scene, points, views, shown, caplog):
    K = views[0].camera.K.numpy()
    w, h, known = views[0].camera.width, views[0].camera.height, tracked(points, views)
    assert known.observed is not None
    images = {}
    for number, view in enumerate(views):
        posed = views[number - 1] if shown == "poses in another order" else view
        viewmat, seen = posed.camera.viewmat.numpy(), known.observed[view.name]
        x, y, z, scalar = Rotation.from_matrix(viewmat[:3, :3]).as_quat()
        features = np.zeros(len(seen), colmap.KEYPOINT)
        features["xy"], features["point"] = known.features[view.name] * [w, h], seen
        if shown == "keypoints of a script":
            features["xy"] = 0
        images[number] = colmap.ColmapImage((scalar, x, y, z), tuple(viewmat[:3, 3]), 1, Path(view.name).name, features)
    ids = np.arange(len(points.positions))
    every = [known.observed[view.name] for view in views]
    keypoints = np.concatenate([np.arange(len(of)) for of in every])
    if shown == "numbers of other keypoints":  # as of OpenMVG's converter
        keypoints //= 2
    tracks = colmap.tracks_of(np.concatenate(every), np.repeat(np.arange(len(every)), [*map(len, every)]), keypoints)
    tracks = tracks[np.argsort(tracks["point"], kind="stable")]
    f = 1.2 if shown == "a focal length of another lens" else 1.0
    camera = colmap.ColmapCamera("PINHOLE", w, h, (f * K[0, 0], f * K[1, 1], K[0, 2], K[1, 2]))
    assert points.colours is not None
    cloud = colmap.Points(points.positions, points.colours, tracks, ids)
    colmap.write_model(scene / "sparse" / "0", colmap.Model({1: camera}, images, cloud), np.zeros(len(ids)))
    (scene / "transforms.json").unlink()
    layout = FacadeDataParserConfig(data=scene)
    check_points(find_sparse_points(layout), read_views(layout))
    told = "sparse/0 are not where their own keypoints show them" in caplog.text
    assert told == (shown not in ("keypoints of a script", "numbers of other keypoints"))


def test_single_cameras_that_contradict_their_keypoints_are_named(points, views, caplog):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, np.radians(3), 0]).as_matrix()
    camera = views[2].camera
    turned = replace(views[2], camera=replace(camera, viewmat=torch.from_numpy(turn) @ camera.viewmat))
    check_points(tracked(points, views), [*views[:2], turned, *views[3:]])
    assert f"1 of {len(views)} cameras, that of {turned.name} for example, do not see" in caplog.text


@pytest.mark.parametrize("inverted", [False, True])
def test_masks_that_ignore_nearly_all_points_are_told(points, views, tmp_path, inverted, caplog):
    passer_by = np.full((views[0].camera.height, views[0].camera.width), 0 if inverted else 255, np.uint8)
    passer_by[8:, 20:26] = 255 - passer_by[0, 0]
    Image.fromarray(passer_by).save(tmp_path / "mask.png")
    check_points(points, [replace(view, mask=tmp_path / "mask.png") for view in views])
    assert ("as if they were inverted: white is kept" in caplog.text) == inverted


def test_points_are_not_compared_with_what_is_transparent(points, views, tmp_path, caplog):
    cut_out = []
    for number, view in enumerate(views):
        image = Image.open(view.image).convert("RGBA")
        image.paste((0, 0, 0, 0), (0, 0, image.width // 2, image.height))
        image.save(tmp_path / f"{number}.png")
        cut_out.append(replace(view, image=tmp_path / f"{number}.png"))
    check_points(points, cut_out)
    check_points(tracked(points, cut_out), cut_out)
    assert not caplog.records


def test_photographs_in_another_order_than_their_cameras_are_told(points, views, caplog):
    known = tracked(points, views)
    mixed = [replace(view, image=other.image) for view, other in zip(views, [*views[5:], *views[:5]], strict=True)]
    check_points(replace(known, colours=255 - points.colours // 8), mixed)  # heights, say, tell nothing
    same = [replace(views[0], name=view.name) for view in views]
    check_points(tracked(points, same), same)
    assert not caplog.records
    check_points(known, mixed)
    assert "the SfM points of sparse/0 have other colours than the photographs that see them" in caplog.text
    check_points(points, mixed)
    assert "may be in another frame than the cameras, or the photographs in another order" in caplog.text


def written_scalar_last(viewmat: np.ndarray) -> np.ndarray:
    """The pose that a quaternion x y z w gives when it is read as w x y z."""
    w, x, y, z = Rotation.from_matrix(viewmat[:3, :3]).as_quat()
    wrong = viewmat.copy()
    wrong[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return wrong


def test_points_without_colours_are_refused_if_no_camera_sees_them(points, views):
    grey = replace(other(points, np.diag([1, -1, -1])), colours=None)
    with pytest.raises(SceneError, match="the cameras: perhaps they have OpenGL's axes"):
        check_points(grey, views)


@pytest.mark.parametrize("colours", [True, False])
def test_points_in_national_coordinates_are_refused_with_their_distance(points, views, colours):
    far = replace(
        points, positions=np.add(points.positions, [4e5, 5e6, 0]), colours=points.colours if colours else None
    )
    with pytest.raises(SceneError, match=r"see 0% of them, and their centre is 6\..e\+05 times as far .* a shift"):
        check_points(far, views)


def test_points_beside_their_place_are_warned_of(points, views, caplog):
    check_points(replace(points, positions=np.add(points.positions, [1.0, 1.0, 0])), views)
    assert "may be in another frame than the cameras" in caplog.text
    assert "they have other colours than the photographs there" in caplog.text


@pytest.mark.parametrize("shown", ["heights", "heights in colours", "inverted intensities", "classes"])
def test_colours_that_are_not_of_photographs_are_not_compared_with_them(points, views, shown, caplog):
    heights = np.argsort(np.argsort(points.positions[:, 1])) / len(points.positions)
    ramp = np.stack([np.clip(2 - abs(4 * heights - middle), 0, 1) for middle in (4, 2, 0)], axis=1)
    grey = {"heights": 255 * heights, "inverted intensities": 255 - points.colours.mean(axis=1)}
    coloured = {"heights in colours": 255 * ramp, "classes": np.where(ramp[:, :1] > 0, [255, 0, 0], [0, 255, 0])}
    colours = coloured[shown] if shown in coloured else np.repeat(grey[shown][:, None], 3, axis=1)
    check_points(replace(points, colours=colours.astype(np.uint8)), views)
    assert not caplog.records


def test_a_slip_explains_nothing_if_cameras_do_not_see_what_it_corrects(points, views):
    """The little that is seen of a real photograph may be alike by chance: its sky and its ground."""
    sight = _Sight.of(other(points, np.diag([1, -1, -1])), views, some_small(views))
    assert sight.explanation(seen=0.0, away=1.0)
    assert replace(sight, cameras=[]).explanation(seen=0.0, away=1.0) is None


def test_points_of_a_long_street_are_accepted_though_each_camera_sees_few_of_them(views, caplog):
    photographs = 1000
    facing, shift = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros((photographs, 3))
    shift[:, 0] = -2 * np.arange(photographs)
    viewmats = [np.vstack([np.column_stack([facing, each]), [0, 0, 0, 1]]) for each in shift]
    street = [replace(views[0], camera=replace(views[0].camera, viewmat=torch.from_numpy(m))) for m in viewmats]
    facades = np.random.default_rng(0).uniform([0, 5, -2], [2 * photographs, 6, 2], (2000, 3))
    check_points(SparsePoints(facades), street)
    assert not caplog.records


def test_a_few_points_show_nothing(points, views):
    check_points(SparsePoints(points.positions[:5] * [1, -1, -1]), views)


def test_training_refuses_a_cloud_in_another_frame(scene):
    """An applied_transform that was applied to the poses only."""
    path = scene / "transforms.json"
    applied = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    transforms = json.loads(path.read_text()) | {"applied_transform": applied[:3].tolist()}
    for frame in transforms["frames"]:
        frame["transform_matrix"] = (applied @ frame["transform_matrix"]).tolist()
    path.write_text(json.dumps(transforms))
    config = FacadeDataParserConfig(data=scene)
    with pytest.raises(SceneError, match=r"transforms\.json names as ply_file_path are not in the frame"):
        config.setup().get_dataparser_outputs("train")
    cloud = trimesh.load(scene / "sparse_pc.ply")
    cloud.apply_transform(applied).export(scene / "sparse_pc.ply")  # pyright: ignore[reportAttributeAccessIssue]
    config.setup().get_dataparser_outputs("train")


def test_every_slip_is_another_one():
    corrections = [slip.correction for slip in slips()]
    assert len(corrections) == 47 + 9
    assert len(np.unique(np.round(corrections, 6), axis=0)) == len(corrections)
    np.testing.assert_allclose([np.abs(np.linalg.det(c)) ** (1 / 3) for c in corrections[:4]], 1)


# Picks and camera positions, and the shell


@pytest.fixture(scope="module")
def place(pristine_scene: Path) -> ShellPlace:
    return ShellPlace(pristine_scene / "shell/facade.ply")


@pytest.fixture(scope="module")
def picks(pristine_scene: Path) -> np.ndarray:
    return np.random.default_rng(0).permutation(load_shell(pristine_scene / "shell/facade.ply").vertices)[:8]


@pytest.fixture(scope="module")
def stood(pristine_scene: Path, views: list[View]) -> np.ndarray:
    """Positions of the cameras in the shell's frame."""
    to_shell = np.linalg.inv(Alignment.load(pristine_scene / ALIGNMENT).shell_to_scene)
    return np.array([to_shell[:3, :3] @ view.camera.position.numpy() + to_shell[:3, 3] for view in views])


def degrees(points: np.ndarray) -> np.ndarray:
    """Longitude, latitude and height, of points in a zone of a national grid around 46° N, 7.9° E."""
    east, north, height = (points - [412_352.0, 5_123_464.0, 0]).T
    return np.stack([7.86 + east / 77_000, 46.25 + north / 110_574, height], axis=1)


SLIPS = [
    (degrees, "are in degrees: .* longitude and latitude"),
    (lambda p: degrees(p)[:, [1, 0, 2]], "are in degrees"),
    (lambda p: p * 1000, MILLIMETRES),
    (lambda p: p / 0.3048, "are in feet instead of metres"),
    (lambda p: p[:, [1, 0, 2]], r"have x and y \(easting and northing\) swapped"),
    (lambda p: p - [412_000.0, 5_123_000.0, 0], r"are -4\d{5} -51\d{5} \S+ away from it, perhaps by a shift"),
]
NAMES = ["degrees", "latitude first", "millimetres", "feet", "northing first", "a shift"]


@pytest.mark.parametrize(("slip", "words"), SLIPS, ids=NAMES)
def test_picks_off_the_shell_are_refused_with_the_slip(place, picks, slip, words):
    with pytest.raises(SceneError, match=f"the picks of a.txt .*{words}"):
        place.check_picks(slip(picks), "the picks of a.txt")


@pytest.mark.parametrize(("slip", "words"), SLIPS, ids=NAMES)
def test_camera_positions_far_from_the_shell_are_refused_with_the_slip(place, stood, slip, words):
    with pytest.raises(SceneError, match=f"the positions of a.txt .*{words}"):
        place.check_positions(slip(stood), "the positions of a.txt")


def test_a_shell_in_another_unit_than_picks_and_positions_is_named(pristine_scene, picks, stood, tmp_path):
    mesh = load_shell(pristine_scene / "shell/facade.ply")
    middle = picks.mean(axis=0)
    trimesh.Trimesh(1000 * (mesh.vertices - middle), mesh.faces, process=False).export(tmp_path / "mm.ply")
    with pytest.raises(SceneError, match=r"frame of the shell .*mm\.ply, .* they are in metres instead of millimetres"):
        ShellPlace(tmp_path / "mm.ply").check_picks(picks - middle, "the picks")
    with pytest.raises(SceneError, match=r"frame of the shell .*mm\.ply, .* they are in metres instead of millimetres"):
        ShellPlace(tmp_path / "mm.ply").check_positions(stood - middle, "the positions")


def test_a_shell_that_was_rounded_is_named_where_picks_are_off_it(picks, pristine_scene, tmp_path):
    mesh = load_shell(pristine_scene / "shell/facade.ply")
    corners = (f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.vertices)  # as Open3D writes an obj: steps of 10 m
    faces = (f"f {a} {b} {c}" for a, b, c in mesh.faces + 1)
    (tmp_path / "six.obj").write_text("\n".join([*corners, *faces]))
    with pytest.raises(
        SceneError, match=r"of the shell .*six\.obj are stored in steps of 1 x 10 .* so the picks are not"
    ):
        ShellPlace(tmp_path / "six.obj").check_picks(picks, "the picks")


def test_picks_on_the_shell_and_cameras_around_it_are_accepted(place, picks, stood):
    rng = np.random.default_rng(0)
    place.check_picks(picks + rng.normal(0, 0.05, picks.shape), "the picks")
    place.check_picks(np.concatenate([picks, picks[:3] + 50]), "the picks")  # a few are wrong, which the fit shows
    place.check_positions(stood, "the positions")
    place.check_positions(np.zeros((0, 3)), "no positions")


def test_picks_up_one_edge_are_not_taken_for_degrees(tmp_path):
    trimesh.creation.box(extents=[20, 10, 12]).export(tmp_path / "box.ply")
    edge = np.array([[10.0, 5, -6], [10, 5, 0], [10, 5, 6]])
    ShellPlace(tmp_path / "box.ply").check_picks(edge, "the picks")


@pytest.mark.parametrize(("count", "length"), [(1, 300), (2, 300), (4, 2000)])
def test_picks_may_be_side_by_side_on_a_long_street(tmp_path, count, length):
    trimesh.creation.box(extents=[length, 10, 12]).export(tmp_path / "street.ply")
    window = np.array([[10.0, 5, 1], [11.2, 5, 1], [10.0, 5, 2.5], [11.2, 5, 2.5]])
    ShellPlace(tmp_path / "street.ply").check_picks(window[:count], "the picks")


def test_a_cloud_of_points_has_a_place_too(place, picks, pristine_scene, tmp_path):
    mesh = load_shell(pristine_scene / "shell/facade.ply")
    cloud = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), 3000, seed=0)[0]
    np.savetxt(tmp_path / "scan.xyz", cloud, fmt="%.3f")
    scanned = ShellPlace(tmp_path / "scan.xyz")
    scanned.check_picks(picks, "the picks")
    np.testing.assert_allclose(scanned.middle, place.middle, atol=0.02 * place.size)


# Alignments


def test_an_alignment_that_puts_the_shell_elsewhere_is_described():
    rng = np.random.default_rng(0)
    seen = rng.uniform([0, 0, 0], [20, 10, 8], (500, 3))
    turned = Rotation.from_euler("z", 30, degrees=True).apply(seen)
    assert apart(turned, seen) is None
    for shift in (100.0, -100.0):
        assert "80.7 away from what the cameras see: a shift" in (apart(np.add(seen, [shift, 0, 0]), seen) or "")
    assert apart(np.add(seen, [60.0, 0, 0]), seen) is None  # a house across the street
    assert "look for another unit" in (apart(1000 * seen, seen) or "")
    assert "look for another unit" in (apart(seen / 1000, seen) or "")


def test_heights_above_the_ellipsoid_are_named_where_others_are_above_the_sea():
    rng = np.random.default_rng(0)
    seen = rng.uniform([0, 0, 0], [20, 2, 8], (500, 3))
    scene = Rotation.from_euler("xyz", [70, 20, 30], degrees=True)  # whatever the axes of structure from motion
    up = scene.apply([0, 0, 1.0])

    def words(*shift: float) -> str | None:
        return heights_apart(scene.apply(np.add(seen, shift)) / 2, scene.apply(seen) / 2, up, metres=2.0)

    assert "some 48 m below what the cameras see" in (words(0, 0, -48) or "")
    assert "some 30 m above what the cameras see" in (words(5, 0, 30) or "")
    assert words(0, 0, 6) is None  # a part of it is at their height
    assert words(0, 30, 30) is None  # it is elsewhere, too
    assert words(0, 3, 0) is None


def test_a_matrix_without_its_global_shift_is_refused_with_the_distance(scene, shellgs):
    true = Alignment.load(scene / ALIGNMENT)
    shift = np.eye(4)
    shift[:3, 3] = [412_000.0, 5_123_000.0, 0.0]
    np.save(scene / "matrix.npy", true.shell_to_scene @ shift)
    refusal = shellgs("align", scene, scene / true.shells[0], "--matrix", scene / "matrix.npy")
    assert "is refused" in refusal
    assert "away from what the cameras see: a shift (such as CloudCompare's --global-shift) is missing" in refusal


def test_degrees_are_within_their_range_and_close_together_beside_a_large_shell():
    house = np.array([[11.57, 48.13, 5], [11.5701, 48.1301, 9], [11.5702, 48.13, 7]])
    assert in_degrees(house, 20.0)
    assert in_degrees(house[:, [1, 0, 2]], 20.0)
    assert not in_degrees(house, 1e-3)  # a model of that size, in units of its own
    assert not in_degrees(np.add(house, [90, 60, 0]), 20.0)  # no latitude is above 90, in either order
    assert not in_degrees(np.add(house, [170, 0, 0]), 20.0)
    assert not in_degrees(house * [100, 1, 1], 20.0)
