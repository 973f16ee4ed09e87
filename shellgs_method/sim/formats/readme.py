"""The README of a folder for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shellgs_method.files.atomic import atomic_write
from shellgs_method.sim.formats.world import Building
from shellgs_method.sim.frame import SimFrame

_TEXT = """# {title}

{frame} z points up, and the ground is the plane z = 0. `frame.json` has the matrices to the
scene's cameras (`to_scene`) and to national coordinates (`to_national`), whose shift is `offset`.

| file | what it is |
|---|---|
| `facade.xml` | MuJoCo's model (MJCF) |
| `facade.urdf`, `facade.sdf` | the same for URDF readers and for Gazebo |
| `facade.usda` | the same for Isaac Sim and other USD readers: visual mesh, colliders, splats (variant `look`) |
| `{folder}collision/part_*.obj` | {parts} convex parts, which are their own convex hulls |
| `{folder}visual.obj`, `.mtl`, `.png` | the visual mesh, with a texture from the photographs |
| `{folder}visual.glb` | the same for browsers; y-up, as glTF requires |
| `{folder}semantics.json` | the class (wall, window, …) of each face of `visual.obj`, if the shell has them; in \
the USD, labels of its parts |
| `{folder}splats.ply` | the Gaussians |
| `{folder}deviations.ply`, `.json` | the shell: red where the building is in front of it, blue behind, grey unseen |
| `report.html`, `metrics.json` | the accuracy of all this, and images |

{summary}

## MuJoCo

```python
import mujoco
model = mujoco.MjModel.from_xml_path("facade.xml")
data = mujoco.MjData(model)
```

To add a robot: `spec = mujoco.MjSpec.from_file("facade.xml")`, then `spec.attach(...)`.

## Isaac Sim

```python
from isaacsim.core.utils.stage import add_reference_to_stage
add_reference_to_stage("facade.usda", "/World/facade")
```

## Gazebo

```sh
export GZ_SIM_RESOURCE_PATH=$PWD
gz sim facade.sdf
```

## PyBullet and other readers of URDF

```python
import pybullet
pybullet.connect(pybullet.DIRECT)
pybullet.loadURDF("facade.urdf", useFixedBase=True)
```
"""


def write_readme(out: Path, buildings: Sequence[Building], frame: SimFrame, metrics: dict) -> None:
    """Write a README with the folder's contents and how each simulator loads it."""
    where = (
        "Coordinates are metres along the shell's axes; the origin is on the ground in front of the facade."
        if frame.metric
        else "The scene has no aligned shell: the unit of length is unknown, and the files state the metre."
    )
    several = len(buildings) > 1
    text = _TEXT.format(
        title=", ".join(building.name for building in buildings),
        frame=where,
        folder="BUILDING/" if several else "",
        parts=" and ".join(str(building.parts) for building in buildings),
        summary="\n".join(f"* {sentence}" for sentence in metrics["summary"]),
    )
    with atomic_write(out / "README.md") as file:
        file.write(text.encode())
