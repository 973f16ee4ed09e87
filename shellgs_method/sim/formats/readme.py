"""The README of a folder for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shellgs_method.files.atomic import write_whole
from shellgs_method.sim.formats.asset import Asset
from shellgs_method.sim.frame import SimFrame
from shellgs_method.sim.ground import Ground

_TEXT = """# {title}

{frame} z points up, from the foot of the facade; the
ground at the origin has a height of {height:.2f}. `frame.json` has the matrices to the
scene's cameras (`to_scene`) and to national coordinates (`to_national`). Coordinates and `offset` add up to those of
the shell with z up, in metres, as in the json of `shellgs mesh`.

| file | what it is |
|---|---|
| `world.xml`, `.usda`, `.sdf`, `.urdf` | ground, light and physics; they refer to the building{plural} |
| `report.html`, `metrics.json` | the accuracy of all this, and images |
{assets}

A building's folder can be copied anywhere, and has no ground, light or physics scene of its own:

| file | what it is |
|---|---|
| `NAME.xml` | MuJoCo's model (MJCF); all names and classes begin with the building's |
| `NAME.usda` | for Isaac Sim and other USD readers; the variant `look` shows the mesh, the splats, or both |
| `model.config`, `model.sdf` | for Gazebo |
| `NAME.urdf`, `package.xml`, `CMakeLists.txt` | for URDF readers, and a ROS package of the building's name |
| `collision/part_*.obj` | the convex parts, which are their own convex hulls |
| `visual.obj`, `.mtl`, `NAME.png` | the visual mesh, with a texture from the photographs |
| `visual_wall.obj`, … | its walls, windows, …, if the shell has classes: segmentation cameras distinguish them |
| `visual.glb` | the same for browsers; y-up, as glTF requires |
| `splats.ply` | the Gaussians |
| `deviations.ply`, `.json` | the shell: red where the building is in front of it, blue behind, grey unseen |

{summary}

## MuJoCo

```python
import mujoco
world = mujoco.MjSpec.from_file("world.xml")
robot = mujoco.MjSpec.from_file("…/unitree_go2/go2.xml")
world.option = robot.option   # time step, cone, impratio, …, which attach leaves out
world.attach(robot, prefix="go2/", frame=world.worldbody.add_frame(pos=[0, 0, {above:.2f}]))
model = world.compile()
```

or in the scene of a robot, from any folder:

```xml
<asset><model name="{first}" file="…/{first}/{first}.xml"/></asset>
<worldbody><attach model="{first}" prefix="{first}/"/></worldbody>
```

(`<include>` of the file works too, if MuJoCo is given the scene by its absolute path.) Looks are in group 2, collision
geometry in group 3, the ground in group 0.

## Isaac Sim

```python
from isaacsim.core.utils.stage import add_reference_to_stage
add_reference_to_stage("{first}/{first}.usda", "/World/{first}")   # in a scene with ground and physics of its own
```

or open `world.usda`. Of the look `both`, the mesh has the purpose *proxy* and the splats *render*. The mesh is unlit:
UsdPreviewSurface has no unit of emission, and RTX shows it dark until `inputs:scale` of `visual/material/texture` is
raised (by some thousands).

## Gazebo

```sh
export GZ_SIM_RESOURCE_PATH=$PWD
gz sim world.sdf
```

Garden or later is needed: Fortress, of ROS 2 Humble, has other names for its systems, and moves nothing (in all `.sdf`
files, replace `gz-sim` by `ignition-gazebo` and `gz::sim` by `ignition::gazebo`). Harmonic or later collides with the
parts' convex hulls, Garden with their triangles.

## PyBullet and other readers of URDF

```python
import pybullet
pybullet.connect(pybullet.DIRECT)
pybullet.loadURDF("world.urdf", useFixedBase=True)   # or {first}/{first}.urdf, on a ground of your own
```

In ROS, a building's folder is a package of its name: copy it into a workspace's `src/`.
"""


def write_readme(out: Path, assets: Sequence[Asset], frame: SimFrame, ground: Ground, metrics: dict) -> None:
    """Write a README with the folder's contents and how each simulator loads it."""
    height = round(float(ground.at(np.zeros((1, 2)))[0]), 2) + 0.0  # not -0.00
    where = (
        "Coordinates are metres along the shell's axes; the origin is in front of the facade."
        if frame.metric
        else "The scene has no aligned shell: the unit of length is unknown, and the files state the metre."
    )
    text = _TEXT.format(
        title=", ".join(asset.name for asset in assets),
        frame=where,
        height=height,
        above=height + 0.1,
        plural="s" if len(assets) > 1 else "",
        assets="\n".join(f"| `{asset.name}/` | a building of {asset.parts} convex parts |" for asset in assets),
        first=assets[0].name,
        summary="\n".join(f"* {sentence}" for sentence in metrics["summary"]),
    )
    write_whole(out / "README.md", text)
