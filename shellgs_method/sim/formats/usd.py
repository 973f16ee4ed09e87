"""Write a world of buildings as USD: visual mesh, colliders with physics, and splats as UsdVol's particle fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from shellgs_method.export.splats import Splats
from shellgs_method.files.usd import add_mesh, import_pxr, make_collider, new_stage
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.formats.world import Building
from shellgs_method.sim.look.texture import TexturedMesh
from shellgs_method.sim.look.visual import TEXTURE

LAYERS = "usd"
"""Folder of the binary layers that ``facade.usda`` refers to, beside the building's other files."""


def write_usd_layers(
    folder: Path,
    mesh: TexturedMesh,
    classes: UInt8[np.ndarray, " F"],
    parts: Sequence[Part],
    splats: Splats,
    metric: bool,
) -> bool:
    """Write visual mesh, colliders and splats of a building, each as a layer.

    Args:
        folder: folder of the building; the layers are in its folder ``usd``.
        mesh: visual mesh, with one texture coordinate for each vertex.
        classes: class of each of its triangles.
        parts: convex parts.
        splats: Gaussians in the frame of the mesh.
        metric: whether the frame's unit is the metre; otherwise it is unknown.

    Returns:
        Whether this USD supports splats: their schema is standard since 26.03.
    """
    pxr = import_pxr("sim")
    (folder / LAYERS).mkdir(exist_ok=True)
    with new_stage(pxr, folder / LAYERS / "visual.usdc", "z", metric) as stage:
        _visual(pxr, stage, mesh, classes)
    with new_stage(pxr, folder / LAYERS / "collision.usdc", "z", metric) as stage:
        _colliders(pxr, stage, parts)
    if not hasattr(pxr.UsdVol, "ParticleField3DGaussianSplat"):
        return False
    with new_stage(pxr, folder / LAYERS / "splats.usdc", "z", metric) as stage:
        _particles(pxr, stage, splats)
    return True


def write_usd_world(path: Path, buildings: Sequence[Building], metric: bool, with_splats: bool) -> None:
    """Write the stage that places the buildings' layers on level ground, with gravity.

    Mesh and splats show the same surface: a variant set ``look`` of each building selects one of them.
    """
    pxr = import_pxr("sim")
    with new_stage(pxr, path, "z", metric) as stage:
        pxr.UsdGeom.Xform.Define(stage, "/World")
        scene = pxr.UsdPhysics.Scene.Define(stage, "/World/physics")
        scene.CreateGravityDirectionAttr(pxr.Gf.Vec3f(0, 0, -1))
        scene.CreateGravityMagnitudeAttr(9.81)
        ground = pxr.UsdGeom.Plane.Define(stage, "/World/ground")
        ground.CreateAxisAttr("Z")
        ground.CreateWidthAttr(200.0)
        ground.CreateLengthAttr(200.0)
        ground.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
        ground.CreateExtentAttr([(-100, -100, 0), (100, 100, 0)])
        pxr.UsdPhysics.CollisionAPI.Apply(ground.GetPrim())
        for building in buildings:
            prim = pxr.UsdGeom.Xform.Define(stage, f"/World/{building.name}").GetPrim()
            for child in ("collision",):
                _refer(pxr, stage, prim, building, child)
            looks = prim.GetVariantSets().AddVariantSet("look")
            for look, child in (("mesh", "visual"), ("splats", "splats"))[: 1 + with_splats]:
                looks.AddVariant(look)
                looks.SetVariantSelection(look)
                with looks.GetVariantEditContext():
                    _refer(pxr, stage, prim, building, child)
            looks.SetVariantSelection("mesh")


def compliance_errors(stage: Path | Any) -> list[str]:
    """Errors that usd-core's own validators, those of ``usdchecker``, find in a stage or its file; a line each."""
    pxr = import_pxr("sim")
    registry = pxr.UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    if isinstance(stage, Path):
        stage = pxr.Usd.Stage.Open(str(stage))
    errors = pxr.UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


def _refer(pxr: SimpleNamespace, stage, prim, building: Building, child: str) -> None:
    kind = "Xform" if child != "splats" else "ParticleField3DGaussianSplat"
    made = stage.DefinePrim(prim.GetPath().AppendChild(child), kind)
    made.GetReferences().AddReference(f"./{building.path(f'{LAYERS}/{child}.usdc')}")


def _visual(pxr: SimpleNamespace, stage, mesh: TexturedMesh, classes: UInt8[np.ndarray, " F"]) -> None:
    pxr.UsdGeom.Xform.Define(stage, "/visual")
    prim = add_mesh(pxr, stage, "/visual/mesh", mesh.vertices, mesh.faces)
    prim.CreateDoubleSidedAttr(True)
    uv = np.ascontiguousarray(mesh.uv, np.float32)
    primvars = pxr.UsdGeom.PrimvarsAPI(prim)
    st = primvars.CreatePrimvar("st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.vertex)
    st.Set(pxr.Vt.Vec2fArray.FromNumpy(uv))
    material = pxr.UsdShade.Material.Define(stage, "/visual/material")
    reader = _shader(pxr, stage, "/visual/material/st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", pxr.Sdf.ValueTypeNames.String).Set("st")
    texture = _shader(pxr, stage, "/visual/material/texture", "UsdUVTexture")
    texture.CreateInput("file", pxr.Sdf.ValueTypeNames.Asset).Set(f"../{TEXTURE}")
    texture.CreateInput("sourceColorSpace", pxr.Sdf.ValueTypeNames.Token).Set("sRGB")
    where = reader.CreateOutput("result", pxr.Sdf.ValueTypeNames.Float2)
    texture.CreateInput("st", pxr.Sdf.ValueTypeNames.Float2).ConnectToSource(where)
    surface = _shader(pxr, stage, "/visual/material/surface", "UsdPreviewSurface")
    surface.CreateInput("roughness", pxr.Sdf.ValueTypeNames.Float).Set(1.0)
    colour = texture.CreateOutput("rgb", pxr.Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", pxr.Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", pxr.Sdf.ValueTypeNames.Token))
    pxr.UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    if classes.any():
        _label(pxr, prim, classes)


def _label(pxr: SimpleNamespace, mesh: Any, classes: UInt8[np.ndarray, " F"]) -> None:
    """Partition a mesh by class, each part with a semantic label."""
    for each in map(SurfaceClass, np.unique(classes)):
        faces = pxr.Vt.IntArray.FromNumpy(np.flatnonzero(classes == each).astype(np.int32))
        kinds = pxr.UsdGeom.Tokens.face, faces, "semantics", pxr.UsdGeom.Tokens.partition
        subset = pxr.UsdGeom.Subset.CreateGeomSubset(mesh, each.word, *kinds)
        pxr.UsdSemantics.LabelsAPI.Apply(subset.GetPrim(), "class").CreateLabelsAttr([each.word])


def _shader(pxr: SimpleNamespace, stage, path: str, kind: str):
    shader = pxr.UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader


def _colliders(pxr: SimpleNamespace, stage, parts: Sequence[Part]) -> None:
    """Add static colliders, as convex hulls, which the parts already are."""
    root = pxr.UsdGeom.Xform.Define(stage, "/collision")
    pxr.UsdGeom.Imageable(root).CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
    for number, part in enumerate(parts):
        prim = add_mesh(pxr, stage, f"/collision/part_{number:03d}", part.vertices, part.faces)
        make_collider(pxr, prim, "convexHull")


def _particles(pxr: SimpleNamespace, stage, splats: Splats) -> None:
    """Add the Gaussians without NaN or infinity; a particle's coefficients are contiguous, by degree, as in Splats."""
    columns = (splats.means, splats.quats, splats.scales, splats.opacities, splats.harmonics)
    kept = torch.stack([column.flatten(1).isfinite().all(dim=1) for column in columns]).all(dim=0)
    means, quats, scales, opacities, harmonics = (column[kept].float() for column in columns)
    quats = torch.nn.functional.normalize(quats, dim=-1)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")

    def array(kind, values: torch.Tensor):
        return kind.FromNumpy(np.ascontiguousarray(values.numpy(), np.float32))

    sizes = scales.exp()
    field.CreatePositionsAttr(array(pxr.Vt.Vec3fArray, means))
    field.CreateOrientationsAttr(array(pxr.Vt.QuatfArray, quats[:, [1, 2, 3, 0]]))  # real part last in memory
    field.CreateScalesAttr(array(pxr.Vt.Vec3fArray, sizes))
    field.CreateOpacitiesAttr(array(pxr.Vt.FloatArray, opacities.sigmoid().flatten()))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(int(np.sqrt(harmonics.shape[1])) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(array(pxr.Vt.Vec3fArray, harmonics.flatten(0, 1)))
    reach = 3 * sizes.amax(dim=1, keepdim=True)
    if len(means):
        field.CreateExtentAttr([tuple((means - reach).amin(0).tolist()), tuple((means + reach).amax(0).tolist())])
