"""Private functions of nerfstudio, gsplat and torch that we call or override. Each is used in one module, named here.

A version that renames one or changes its parameters fails here, by name, before it fails somewhere in a training.
"""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import gsplat
import pytest

ROOT = Path(__file__).parents[1]
DATAMANAGER = "nerfstudio.data.datamanagers.full_images_datamanager"
PRIVATE = [
    ("shellgs_method/files/undistortion.py", DATAMANAGER, "_undistort_image", "camera distortion_params data image K"),
    (
        "dataparsers/facade.py",
        "nerfstudio.data.dataparsers.base_dataparser",
        "DataParser._generate_dataparser_outputs",
        "self split",
    ),
    (
        "shellgs_method/datamanager.py",
        DATAMANAGER,
        "FullImageDatamanager._load_images",
        "self split cache_images_device",
    ),
    ("shellgs_method/trainer.py", "nerfstudio.engine.trainer", "Trainer._load_checkpoint", "self"),
    ("shellgs_method/trainer.py", "nerfstudio.engine.trainer", "Trainer._after_train", "self"),
    ("shellgs_method/model.py", "nerfstudio.models.splatfacto", "SplatfactoModel._get_background_color", "self"),
    ("shellgs_method/machine/gsplat_kernels.py", "torch.utils.cpp_extension", "_get_build_directory", "name verbose"),
    ("shellgs_method/viewer.py", "nerfstudio.viewer.viewer_elements", "ViewerControl._setup", "self viewer"),
    *(
        ("shellgs_method/gaussians/densification.py", "gsplat.strategy.default", f"DefaultStrategy.{name}", parameters)
        for name, parameters in {
            "_grow_gs": "self params optimizers state step",
            "_prune_gs": "self params optimizers state step",
        }.items()
    ),
]


@pytest.mark.parametrize(
    ("module", "path", "parameters"), [each[1:] for each in PRIVATE], ids=[each[2] for each in PRIVATE]
)
def test_a_private_function_is_there_with_its_parameters(module: str, path: str, parameters: str):
    found: Any = importlib.import_module(module)
    for name in path.split("."):
        found = getattr(found, name)
    given = list(inspect.signature(found).parameters)
    assert given[: len(parameters.split())] == parameters.split()


def test_gsplat_keeps_its_kernels_where_we_ask_for_them():
    """Read, not imported: without a GPU the import tries to compile them."""
    assert gsplat.__file__
    assert re.search(r"^\s*_C\b.* = ", (Path(gsplat.__file__).parent / "cuda/_backend.py").read_text(), re.MULTILINE)


def test_each_is_used_in_one_module():
    sources = {
        str(file.relative_to(ROOT)): file.read_text("utf8")
        for folder in ("dataparsers", "shellgs_method")
        for file in (ROOT / folder).rglob("*.py")
    }
    for user, _, path, _ in PRIVATE:
        name = path.rpartition(".")[2]
        assert [file for file, text in sources.items() if re.search(rf"\b{name}\b", text)] == [user], name
