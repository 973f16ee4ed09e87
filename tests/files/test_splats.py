"""Files of Gaussians, decoded here by their specifications, and in a slow test by programs that others wrote."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_files import glb_attributes, psnr, some, unpacked

from shellgs_method.errors import SceneError
from shellgs_method.export.splats import moved
from shellgs_method.files import splats as files_splats
from shellgs_method.files.splats import DISCS, Splats, check_splats_format, read_splats, write_splats

NODE = Path(os.environ["SHELLGS_NODE"]) / "node_modules" if "SHELLGS_NODE" in os.environ else None


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_gltf_has_linear_scales_and_opacities_and_each_coefficient_by_itself(tmp_path, degree):
    splats = some(degree=degree)
    write_splats(tmp_path / "a.glb", splats, ["unit: metre"])
    document, attributes = glb_attributes(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["asset"]["extras"] == {"comments": ["unit: metre"]}
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    own = {name.split(":")[1]: values for name, values in attributes.items() if ":" in name}
    np.testing.assert_array_equal(attributes["POSITION"], splats.means)
    np.testing.assert_allclose(own["SCALE"], splats.scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(own["OPACITY"], splats.opacities.sigmoid(), rtol=1e-6)
    expected = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(own["ROTATION"]).as_matrix(), expected, atol=1e-6)
    names = [f"SH_DEGREE_{each}_COEF_{k}" for each in range(degree + 1) for k in range(2 * each + 1)]
    assert [name for name in own if name.startswith("SH")] == names
    np.testing.assert_array_equal(np.stack([own[name] for name in names], axis=1), splats.harmonics)
    np.testing.assert_allclose(attributes["COLOR_0"][:, 3] / 255, own["OPACITY"][:, 0], atol=0.003)


def test_the_header_of_a_ply_is_ascii_of_a_line_for_each_comment(tmp_path):
    """A coordinate reference system may have any name; viewers count letters, not bytes, to find the data."""
    splats = some()
    write_splats(tmp_path / "a.ply", splats, ['crs: LOCALCRS["Zürich\nSüd"]'])
    header, end, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert rb'comment crs: LOCALCRS["Z\xfcrich S\xfcd"]' in header.splitlines()
    text = (tmp_path / "a.ply").read_bytes().decode("utf-8", "replace")
    assert text.index("end_header\n") == len(header)
    assert end
    assert len(body) == 62 * 4 * len(splats)


def test_spz_renders_as_what_was_written(tmp_path):
    splats = some()
    write_splats(tmp_path / "a.spz", splats)
    read = unpacked(tmp_path / "a.spz")
    assert (read.means - splats.means).abs().max() < 1e-5
    assert (read.scales - splats.scales).abs().max() <= 1 / 32 + 1e-6
    turned = Rotation.from_quat(read.quats.numpy()) * Rotation.from_quat(splats.quats.numpy()).inv()
    assert turned.magnitude().max() < 0.006
    assert psnr(read, splats) > 45
    assert (tmp_path / "a.spz").stat().st_size < 80 * len(splats)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_glb_of_more_bytes_than_its_header_counts_is_refused_before_it_is_made(tmp_path, monkeypatch, degree):
    """By an estimate that is within the header's and the json's few kilobytes of what is written."""
    splats = some(degree=degree)
    write_splats(tmp_path / "a.glb", splats)
    assert 0 <= (tmp_path / "a.glb").stat().st_size - files_splats._bytes_of_glb(splats) < 2**15
    monkeypatch.setattr(files_splats, "_LARGEST_GLB", 2**16 + 1000)
    with pytest.raises(SceneError, match=r"more than the 4 GB of a glb: name a \.ply"):
        write_splats(tmp_path / "b.glb", splats)


def test_coordinates_that_spz_cannot_hold_are_refused(tmp_path):
    far = some(2)
    far.means[0, 0] = 9e6
    with pytest.raises(SceneError, match=r"too far for spz: name a \.ply or \.glb"):
        write_splats(tmp_path / "a.spz", far)
    far.means[0, 0] = 9e5
    write_splats(tmp_path / "a.spz", far)
    assert unpacked(tmp_path / "a.spz").means[0, 0] == 9e5


def test_a_ply_of_discs_says_so_and_what_its_coordinates_are(tmp_path):
    write_splats(tmp_path / "a.ply", some(discs=True), ["unit: metre"])
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode().split("\n")
    assert header[:5] == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 400",  # in the third line, where the viewer of 3D Gaussian Splatting looks for it
        f"comment {DISCS}",
        "comment unit: metre",
    ]


@pytest.mark.parametrize(
    ("count", "degree", "discs"), [(400, 0, False), (400, 2, False), (400, 3, True), (0, 3, False)]
)
def test_a_ply_is_read_as_it_was_written(tmp_path, count, degree, discs):
    splats = some(count, degree, discs=discs)
    write_splats(tmp_path / "a.ply", splats, ["unit: metre"])
    read = read_splats(tmp_path / "a.ply")
    assert read.discs == discs
    for name in ("means", "scales", "opacities", "harmonics"):
        assert torch.equal(getattr(read, name), getattr(splats, name))
    torch.testing.assert_close(read.quats, torch.nn.functional.normalize(splats.quats, dim=-1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content[:-1], "is damaged"),
        (lambda content: b"solid", "is damaged"),
        (lambda content: content.replace(b"property float opacity", b"property float density"), "it has no opacity"),
        (lambda content: content.replace(b"property float x", b"property double x"), "is damaged, or not"),
        (lambda content: content.replace(b"property float nx", b"property float f_rest_99"), "is damaged, or not"),
    ],
)
def test_a_file_that_is_no_ply_of_gaussians_is_refused(tmp_path, change, message):
    write_splats(tmp_path / "a.ply", some())
    (tmp_path / "a.ply").write_bytes(change((tmp_path / "a.ply").read_bytes()))
    with pytest.raises(SceneError, match=message):
        read_splats(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("name", "discs", "message"), [("a.splat", False, "ply, glb, spz or html"), ("a.spz", True, "spz has no discs")]
)
def test_formats_that_cannot_be_written_are_refused(tmp_path, name, discs, message):
    with pytest.raises(SceneError, match=message):
        check_splats_format(tmp_path / name, discs)


def test_gaussians_that_are_too_large_for_spz_are_told(tmp_path, caplog):
    """Those of the background of a scene in millimetres were cut without a word."""
    splats = some()
    write_splats(tmp_path / "a.spz", splats)
    assert not caplog.text
    splats.scales[:3, 0] = 7.0
    write_splats(tmp_path / "a.spz", splats)
    assert "3 Gaussians have standard deviations of more than 379 units" in caplog.text


def columns(path: Path) -> dict[str, np.ndarray]:
    header, _, data = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().split("\n") if line.startswith("property float")]
    return dict(zip(names, np.frombuffer(data, "<f4").reshape(-1, len(names)).T, strict=True))


@pytest.mark.slow
@pytest.mark.skipif(
    NODE is None, reason="SHELLGS_NODE names no folder with @playcanvas/splat-transform, gltf-validator"
)
def test_programs_of_others_read_the_files(tmp_path):
    """PlayCanvas' splat-transform reads ply and spz, and writes the same glTF; Khronos' validator has no errors.

    To it, y points down in a ply, and up in the others; it turns glTF about z, and spz about x.
    """
    assert NODE is not None
    splats = some()
    write_splats(tmp_path / "ours.ply", splats)
    write_splats(tmp_path / "ours.glb", moved(splats, np.diag([-1.0, -1, 1, 1])))
    write_splats(tmp_path / "ours.spz", moved(splats, np.diag([1.0, -1, -1, 1])))
    for source, target in (("ours.ply", "theirs.glb"), ("ours.spz", "theirs.ply")):
        transform = NODE / ".bin" / "splat-transform"
        subprocess.run([transform, "-w", tmp_path / source, tmp_path / target], check=True, capture_output=True)
    (_, ours), (_, theirs) = (glb_attributes(tmp_path / f"{name}.glb") for name in ("ours", "theirs"))
    assert ours.keys() == theirs.keys()
    by_place = [np.lexsort(each["POSITION"].T) for each in (ours, theirs)]
    for name in ours:
        one, other = ours[name][by_place[0]], theirs[name][by_place[1]]
        np.testing.assert_allclose(one.astype(float), other, atol=1 if name == "COLOR_0" else 2e-6, err_msg=name)
    read = columns(tmp_path / "theirs.ply")
    harmonics = [[f"f_dc_{c}" for c in range(3)], *([f"f_rest_{15 * c + k}" for c in range(3)] for k in range(15))]
    fields = [["x", "y", "z"], [f"rot_{k}" for k in range(4)], [f"scale_{k}" for k in range(3)], ["opacity"]]
    tensors = [torch.from_numpy(np.stack([read[name] for name in names], axis=-1).copy()) for names in fields]
    coefficients = np.stack([np.stack([read[name] for name in names], axis=-1) for names in harmonics], axis=1)
    assert psnr(Splats(*tensors, *[torch.from_numpy(coefficients)]), splats) > 38
    script = "require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
    script += ".then(report => console.log(JSON.stringify(report.issues)))"
    found = subprocess.run(
        ["node", "-e", script, str(tmp_path / "ours.glb")], cwd=NODE.parent, check=True, capture_output=True, text=True
    )
    messages = json.loads(found.stdout)["messages"]
    errors = [each for each in messages if each["severity"] == 0]
    assert all("KHR_gaussian_splatting:" in each["pointer"] for each in errors), (
        errors
    )  # of names that it does not know
