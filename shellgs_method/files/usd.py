"""USD: stages with their unit and up axis, triangle meshes, and static colliders."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import unfinished
from shellgs_method.machine.extras import import_extra

USD_FORMATS = (".usd", ".usda", ".usdc")


def import_pxr(extra: Literal["usd", "sim"], what: str = "USD") -> SimpleNamespace:
    """Import the modules of usd-core.

    Raises:
        SceneError: usd-core is not installed, or too old.
    """
    schemas = "UsdGeom", "UsdLux", "UsdPhysics", "UsdSemantics", "UsdShade", "UsdVol"
    names = "Gf", "Sdf", "Usd", "UsdValidation", "Vt", *schemas
    return SimpleNamespace(**{name: import_extra(f"pxr.{name}", "usd-core", extra, what) for name in names})


@contextmanager
def new_stage(pxr: SimpleNamespace, path: Path, up: Literal["y", "z"], metric: bool) -> Iterator[Any]:
    """A stage whose default prim is its first; the file gets its name once it is complete.

    The unit that it states is the metre, since every reader takes a stage that states none for centimetres; if
    ``metric`` is false, it is unknown, which a comment says.

    Raises:
        SceneError: the file cannot be written.
    """
    temporary = unfinished(path, path.suffix)
    try:
        stage = pxr.Usd.Stage.CreateNew(str(temporary))
        pxr.UsdGeom.SetStageUpAxis(stage, up.upper())
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        if not metric:
            stage.GetRootLayer().comment = "The unit is unknown: metersPerUnit is 1 because a stage must state it."
        yield stage
        stage.SetDefaultPrim(stage.GetPseudoRoot().GetChildren()[0])
        stage.GetRootLayer().Save()
        os.replace(temporary, path)
    except RuntimeError as error:  # pxr's, whose message says little
        raise SceneError(f"{path} cannot be written: is there room on the disk? ({str(error)[:200]})") from error
    finally:
        temporary.unlink(missing_ok=True)


def add_mesh(
    pxr: SimpleNamespace, stage: Any, path: str, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Any:
    """Add a triangle mesh at a path of the stage, and return it."""
    prim = pxr.UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(vertices, np.float32)
    prim.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
    prim.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    prim.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    return prim


def make_collider(pxr: SimpleNamespace, mesh: Any, approximation: Literal["none", "convexHull"]) -> None:
    """Make a mesh a static collider: of its triangles themselves, or of its convex hull, the default of engines."""
    pxr.UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    pxr.UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(approximation)
