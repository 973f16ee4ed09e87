"""The shell pipeline on photographs of real facades; the data are not part of the project."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.utils.colmap_parsing_utils import read_points3D_binary
from scenes import cast, views_of

from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.shell import Alignment

DATA = Path(os.environ.get("SHELLGS_DATA", Path(__file__).parents[2] / "shared" / "data"))
SCENES = {"herz-jesu-p25": "herz_jesu_survey.ply", "south-building-26": "south_building_survey.ply"}

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no real scenes in {DATA}; set SHELLGS_DATA to their folder")


@pytest.mark.parametrize("name", SCENES)
def test_the_cast_shell_agrees_with_the_sfm_points(tmp_path: Path, name: str):
    scene = tmp_path / name
    shutil.copytree(DATA / name, scene, copy_function=os.symlink)
    shell = (f"shell/{SCENES[name]}",)
    alignment = Alignment.from_matrix_file(scene / "shell" / "shell_to_scene.txt", shell)
    views = views_of(scene)[::8]
    cast(scene, views, alignment, max_image_size=384)
    maps = CueMaps.open(scene, "shell")
    cloud = read_points3D_binary(scene / "colmap" / "sparse" / "0" / "points3D.bin")
    points = np.array([point.xyz for point in cloud.values()])
    errors = []
    for view in views:
        camera = view.camera.shrunk(384)
        cue = maps.read(view.name, camera)
        assert cue is not None
        seen = points @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
        seen = seen[seen[:, 2] > 0]
        column, row, _ = np.floor(seen @ camera.K.numpy().T / seen[:, 2:]).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        depth = cue.depth[row[inside], column[inside]]
        errors.append(np.abs(seen[inside, 2] / depth - 1)[depth > 0])
    # Includes points hidden behind a relief: the median stands for those that are visible.
    assert np.median(np.concatenate(errors)) < 0.005
