"""USD: a building as an asset with visual mesh, colliders and splats (UsdVol's particle fields), and its world."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from jaxtyping import UInt8

from shellgs_method.files.splats import Splats
from shellgs_method.files.usd import add_mesh, import_pxr, make_collider, new_stage
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.formats.asset import FRICTION, Asset
from shellgs_method.sim.ground import Ground
from shellgs_method.sim.look.texture import TexturedMesh
from shellgs_method.sim.look.visual import texture_file

LAYERS = "usd"
"""Folder of the binary layers that an asset refers to, in the asset's."""
LOOKS = {"mesh": ("visual",), "splats": ("splats",), "both": ("visual", "splats")}
"""What each variant of the set ``look`` shows."""


def write_usd_asset(
    folder: Path,
    name: str,
    mesh: TexturedMesh,
    classes: UInt8[np.ndarray, " F"],
    parts: Sequence[Part],
    splats: Splats,
    metric: bool,
) -> None:
    """Write a building as ``NAME.usda`` and binary layers: static, without scene, ground or light.

    Mesh and splats show the same surface. Of the look ``both``, the mesh has the purpose *proxy*, for depth sensors,
    and the splats have *render*, for cameras.

    Args:
        folder: folder of the asset; the layers are in its folder ``usd``.
        name: name of the asset and its prim.
        mesh: visual mesh, with one texture coordinate for each vertex.
        classes: class of each of its triangles.
        parts: convex parts.
        splats: Gaussians in the frame of the mesh.
        metric: whether the frame's unit is the metre; otherwise it is unknown.
    """
    pxr = import_pxr("sim")
    (folder / LAYERS).mkdir(exist_ok=True)
    with new_stage(pxr, folder / LAYERS / "visual.usdc", "z", metric) as stage:
        _visual(pxr, stage, name, mesh, classes)
    with new_stage(pxr, folder / LAYERS / "collision.usdc", "z", metric) as stage:
        _colliders(pxr, stage, parts)
    with new_stage(pxr, folder / LAYERS / "splats.usdc", "z", metric) as stage:
        _particles(pxr, stage, splats)
    with new_stage(pxr, folder / f"{name}.usda", "z", metric) as stage:
        root = pxr.UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
        model = pxr.Usd.ModelAPI(root)
        model.SetKind("component")
        model.SetAssetName(name)
        model.SetAssetIdentifier(f"./{name}.usda")
        _label(pxr, root, "building")
        _refer(stage, root, "collision")
        looks = root.GetVariantSets().AddVariantSet("look")
        for look, children in LOOKS.items():
            looks.AddVariant(look)
            looks.SetVariantSelection(look)
            with looks.GetVariantEditContext():
                made = [pxr.UsdGeom.Imageable(_refer(stage, root, child)) for child in children]
                if look == "both":
                    made[0].CreatePurposeAttr(pxr.UsdGeom.Tokens.proxy)
                    made[1].CreatePurposeAttr(pxr.UsdGeom.Tokens.render)
                    made[1].SetProxyPrim(made[0])
        looks.SetVariantSelection("mesh")


def write_usd_world(path: Path, assets: Sequence[Asset], metric: bool, ground: Ground, mesh: Triangles | None) -> None:
    """Write the stage that has gravity, ground (level if there is no mesh) and light, and refers to the assets."""
    pxr = import_pxr("sim")
    with new_stage(pxr, path, "z", metric) as stage:
        world = pxr.UsdGeom.Xform.Define(stage, "/World").GetPrim()
        pxr.Usd.ModelAPI(world).SetKind("assembly")
        scene = pxr.UsdPhysics.Scene.Define(stage, "/World/physics")
        scene.CreateGravityDirectionAttr(pxr.Gf.Vec3f(0, 0, -1))
        scene.CreateGravityMagnitudeAttr(9.81)
        pxr.UsdLux.DomeLight.Define(stage, "/World/light").CreateIntensityAttr(1000)  # for robots: buildings are unlit
        _ground(pxr, stage, ground, mesh)
        for asset in assets:
            prim = stage.DefinePrim(f"/World/{asset.name}")
            prim.GetReferences().AddReference(f"./{asset.name}/{asset.name}.usda")


def _ground(pxr: SimpleNamespace, stage, ground: Ground, mesh: Triangles | None) -> None:
    if mesh is None:
        side = ground.extent
        made = pxr.UsdGeom.Plane.Define(stage, "/World/ground")
        made.CreateAxisAttr("Z")
        made.CreateWidthAttr(side)
        made.CreateLengthAttr(side)
        made.CreateExtentAttr([(-side / 2, -side / 2, 0), (side / 2, side / 2, 0)])
        pxr.UsdPhysics.CollisionAPI.Apply(made.GetPrim())
    else:
        made = add_mesh(pxr, stage, "/World/ground", mesh.vertices, mesh.faces)
        make_collider(pxr, made, "none")
    made.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
    _rub(pxr, made, _friction(pxr, stage, "/World/friction"))


def _refer(stage, root, child: str):
    made = stage.DefinePrim(root.GetPath().AppendChild(child))
    made.GetReferences().AddReference(f"./{LAYERS}/{child}.usdc")
    return made


def _friction(pxr: SimpleNamespace, stage, path: str):
    """Add a physics material, and return it."""
    material = pxr.UsdShade.Material.Define(stage, path)
    friction = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    friction.CreateStaticFrictionAttr(FRICTION)
    friction.CreateDynamicFrictionAttr(FRICTION)
    friction.CreateRestitutionAttr(0.0)
    return material


def _rub(pxr: SimpleNamespace, collider, material) -> None:
    """Bind a physics material to the collider itself: UsdPhysics' own parser does not look at the prims above it."""
    binding = pxr.UsdShade.MaterialBindingAPI.Apply(collider.GetPrim())
    binding.Bind(material, pxr.UsdShade.Tokens.weakerThanDescendants, "physics")


def _visual(pxr: SimpleNamespace, stage, name: str, mesh: TexturedMesh, classes: UInt8[np.ndarray, " F"]) -> None:
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
    texture.CreateInput("file", pxr.Sdf.ValueTypeNames.Asset).Set(f"../{texture_file(name)}")
    texture.CreateInput("sourceColorSpace", pxr.Sdf.ValueTypeNames.Token).Set("sRGB")
    where = reader.CreateOutput("result", pxr.Sdf.ValueTypeNames.Float2)
    texture.CreateInput("st", pxr.Sdf.ValueTypeNames.Float2).ConnectToSource(where)
    surface = _shader(pxr, stage, "/visual/material/surface", "UsdPreviewSurface")
    # Unlit, since the light is in the photographs: it emits, and reflects nothing.
    colour = texture.CreateOutput("rgb", pxr.Sdf.ValueTypeNames.Float3)
    surface.CreateInput("emissiveColor", pxr.Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    surface.CreateInput("useSpecularWorkflow", pxr.Sdf.ValueTypeNames.Int).Set(1)
    for name in ("diffuseColor", "specularColor"):
        surface.CreateInput(name, pxr.Sdf.ValueTypeNames.Color3f).Set((0, 0, 0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", pxr.Sdf.ValueTypeNames.Token))
    pxr.UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    for each in map(SurfaceClass, np.unique(classes) if classes.any() else ()):
        faces = pxr.Vt.IntArray.FromNumpy(np.flatnonzero(classes == each).astype(np.int32))
        kinds = pxr.UsdGeom.Tokens.face, faces, "semantics", pxr.UsdGeom.Tokens.partition
        _label(pxr, pxr.UsdGeom.Subset.CreateGeomSubset(prim, each.word, *kinds).GetPrim(), each.word)


def _label(pxr: SimpleNamespace, prim, label: str) -> None:
    pxr.UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr([label])


def _shader(pxr: SimpleNamespace, stage, path: str, kind: str):
    shader = pxr.UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader


def _colliders(pxr: SimpleNamespace, stage, parts: Sequence[Part]) -> None:
    """Add static colliders, as convex hulls, which the parts already are."""
    root = pxr.UsdGeom.Xform.Define(stage, "/collision")
    pxr.UsdGeom.Imageable(root).CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
    material = _friction(pxr, stage, "/collision/friction")
    for number, part in enumerate(parts):
        prim = add_mesh(pxr, stage, f"/collision/part_{number:03d}", part.vertices, part.faces)
        make_collider(pxr, prim, "convexHull")
        _rub(pxr, prim, material)


def _particles(pxr: SimpleNamespace, stage, splats: Splats) -> None:
    """Add the Gaussians without NaN or infinity; a particle's coefficients are contiguous, by degree, as in Splats."""
    splats = splats.finite
    means, scales, harmonics = splats.means, splats.scales, splats.harmonics
    quats = torch.nn.functional.normalize(splats.quats, dim=-1)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")

    def array(kind, values: torch.Tensor):
        return kind.FromNumpy(np.ascontiguousarray(values.numpy(), np.float32))

    sizes = scales.exp()
    field.CreatePositionsAttr(array(pxr.Vt.Vec3fArray, means))
    field.CreateOrientationsAttr(array(pxr.Vt.QuatfArray, quats[:, [1, 2, 3, 0]]))  # real part last in memory
    field.CreateScalesAttr(array(pxr.Vt.Vec3fArray, sizes))
    field.CreateOpacitiesAttr(array(pxr.Vt.FloatArray, splats.opacities.sigmoid().flatten()))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(array(pxr.Vt.Vec3fArray, harmonics.flatten(0, 1)))
    reach = 3 * sizes.amax(dim=1, keepdim=True)
    if len(means):
        field.CreateExtentAttr([tuple((means - reach).amin(0).tolist()), tuple((means + reach).amax(0).tolist())])
