"""The README of a folder for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dataparsers.files import atomic_write
from shellgs_method.sim.frame import SimFrame
from shellgs_method.sim.world import Building

_TEXT = """# {title}

{frame} z points up, and the ground is the plane z = 0. `frame.json` has the matrices to the
scene's cameras (`to_scene`) and to national coordinates (`to_national`), whose shift is `offset`.

| file | what it is |
|---|---|
| `facade.xml` | MuJoCo's model (MJCF) |
| `facade.urdf`, `facade.sdf` | the same for robots' tools and for Gazebo |
| `facade.usda` | the same for Isaac Sim and other readers of USD: look, colliders, splats (variant `look`) |
| `{folder}collision/part_*.obj` | {parts} convex parts; engines may take their hulls as they are |
| `{folder}visual.obj`, `.mtl`, `.png` | the look, with a texture from the photographs |
| `{folder}visual.glb` | the same for browsers; y-up, as glTF wants it |
| `{folder}splats.ply` | the Gaussians |
| `{folder}deviations.ply`, `.json` | the shell: red where the building stands before it, blue behind, grey not seen |
| `report.html`, `metrics.json` | how far off all of it is, and images |

{summary}

## MuJoCo

```python
import mujoco
model = mujoco.MjModel.from_xml_path("facade.xml")
data = mujoco.MjData(model)
```

To put a robot in: `spec = mujoco.MjSpec.from_file("facade.xml")`, then `spec.attach(...)`.

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
    """Write what is in the folder, and how each simulator loads it."""
    where = (
        "Coordinates are metres along the shell's axes; the origin is on the ground before the facade."
        if frame.metric
        else "The scene has no aligned shell: the unit of length is unknown."
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
