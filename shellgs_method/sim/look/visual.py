"""Write the textured mesh: glb for browsers, obj with its texture for simulators."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Int64, UInt8
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from shellgs_method.errors import notice
from shellgs_method.files.atomic import atomic_write, write_whole
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import area_vectors
from shellgs_method.sim.look.texture import TexturedMesh

LEAST_TEXTURE = 64
"""Shorter side in pixels below which a texture is scaled down no further: it shows nothing, and has hardly a size."""
LEAST_AREA = 1e-4
"""Square metres below which there is no class of surface in a building."""

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turns z-up coordinates into y-up ones."""


def visual_file(each: SurfaceClass) -> str:
    """The obj of the triangles of a class; all are OTHER where no classes are known."""
    return f"visual_{each.word}.obj" if each else "visual.obj"


def without_specks(mesh: TexturedMesh, classes: UInt8[np.ndarray, " F"]) -> UInt8[np.ndarray, " F"]:
    """Classes of a mesh's triangles, with the largest in place of those that have next to no surface.

    MuJoCo refuses a mesh of less than four vertices, or without area, and so the whole world.
    """
    areas = np.bincount(classes, np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1))
    corners = {each: np.unique(mesh.faces[classes == each]) for each in np.unique(classes)}
    specks = [each for each in corners if areas[each] < LEAST_AREA or len(corners[each]) < 4]
    return np.where(np.isin(classes, specks), areas.argmax(), classes).astype(np.uint8)


def texture_file(name: str) -> str:
    """The texture of a building, by whose name Gazebo tells textures apart, whatever their folders are."""
    return f"{name}.png"


def write_visual(folder: Path, mesh: TexturedMesh, classes: UInt8[np.ndarray, " F"], megabytes: float) -> dict:
    """Write ``visual.glb`` (y-up, as glTF requires), and objs with ``visual.mtl`` and the texture.

    The texture of the glb alone is scaled down: simulators show the png. There is an obj for each class of
    surface: simulators segment images by object.

    Args:
        folder: output folder, with the name of the building.
        mesh: textured mesh, z up.
        classes: class of each triangle.
        megabytes: maximum size of the glb; its texture is scaled down to fit.

    Returns:
        Size of the glb in bytes, and of both textures in pixels.
    """
    content, small = _glb_within(mesh, 1e6 * megabytes)
    if len(content) > 1e6 * megabytes:
        notice(
            f"visual.glb of {folder.name} has {len(content) / 1e6:.3g} MB, more than {megabytes:g}, with hardly any "
            "texture: give fewer --faces or more --megabytes."
        )
    write_whole(folder / "visual.glb", content)
    texture = texture_file(folder.name)
    with atomic_write(folder / texture) as file:
        mesh.image.save(file, "PNG")
    write_whole(folder / "visual.mtl", f"newmtl visual\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {texture}\n")
    for each in map(SurfaceClass, np.unique(classes)):
        write_whole(folder / visual_file(each), _obj(mesh, mesh.faces[classes == each]))
    sizes = {"texture": list(mesh.image.size), "glb_texture": list(small)}
    return {"glb_bytes": len(content), **sizes, "triangles": len(mesh.faces)}


def _glb_within(mesh: TexturedMesh, most: float) -> tuple[bytes, tuple[int, int]]:
    """The glb with its texture scaled down to fit into some bytes, and that texture's size.

    It is larger than that if its triangles alone are.
    """
    image = mesh.image
    content = _glb(mesh, image)
    while len(content) > most and min(image.size) >= LEAST_TEXTURE:
        shrink = min(0.9, float(np.sqrt(most / len(content))))
        width, height = (max(1, int(side * shrink)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
        content = _glb(mesh, image)
    return content, image.size


def _glb(mesh: TexturedMesh, image: Image.Image) -> bytes:
    """The glb with its texture as JPEG; matt, since the lighting is in the photographs."""
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=90)
    material = PBRMaterial(
        baseColorTexture=Image.open(buffer), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = TextureVisuals(uv=mesh.uv, material=material)
    turned = trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False).apply_transform(Y_UP)
    content = turned.export(file_type="glb")
    assert isinstance(content, bytes)
    return content


def _obj(mesh: TexturedMesh, faces: Int64[np.ndarray, "F 3"]) -> str:
    """The obj of some of the faces, with one texture coordinate for each vertex."""
    used, faces = np.unique(faces, return_inverse=True)
    lines = ["mtllib visual.mtl", "o visual", "usemtl visual"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices[used].tolist()]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in mesh.uv[used].tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (faces.reshape(-1, 3) + 1).tolist()]
    return "\n".join(lines) + "\n"
