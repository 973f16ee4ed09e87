"""How much geometry in front of the shell the photographs reveal, on the synthetic facade with its true geometry.

python -m benchmarks.check --width 640
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import tyro

from dataparsers.cue_maps import CueMaps
from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
from shellgs_method.shell import ALIGNMENT, Alignment, cast_views, check_views
from shellgs_method.synthetic import FacadeConfig, write_scene
from shellgs_method.synthetic.appearance import rays
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.scene import Facade

NEARER = 0.1
"""Metres by which the true geometry must be nearer than the shell to count."""


def main(width: int = 320, views: int = 40, seed: int = 0) -> None:
    """Print recall and precision over the pixels of all views, recall by material, and times."""
    config = FacadeConfig(width=width, height=width * 9 // 16, views=views, seed=seed)
    facade = Facade.build(config)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        write_scene(scene, config)
        parsed = FacadeDataParserConfig(data=scene)
        photographs = read_views(parsed)
        start = time.perf_counter()
        cast_views(scene, photographs, Alignment.load(scene / ALIGNMENT))
        cast = time.perf_counter() - start
        seconds = check_views(scene, photographs, held_out_names(parsed)).seconds
        shell, truth, checked = (CueMaps.open(scene, kind) for kind in ("shell", "truth", "checked"))
        unit = shell.manifest.metres_per_unit
        assert unit is not None
        there, found, right = Counter[str](), 0, Counter[str]()
        for view, camera in zip(photographs, facade.cameras, strict=True):
            on, real, said = (maps.read(view.name, view.camera) for maps in (shell, truth, checked))
            assert on is not None
            assert real is not None
            assert said is not None
            before = (on.depth > 0) & (real.depth > 0) & ((on.depth - real.depth) * unit > NEARER)
            material = facade.daylight.world.cast(*rays(camera)).material
            found += int(said.mask.sum())
            for kind in np.unique(material[before]):
                name = Material(kind).name.lower()
                there[name] += int((before & (material == kind)).sum())
                right[name] += int((before & said.mask & (material == kind)).sum())
    recall, precision = sum(right.values()) / sum(there.values()), sum(right.values()) / max(found, 1)
    print(f"{views} views of {width} x {config.height}: recall {recall:.2f}, precision {precision:.2f}")
    for name, count in there.most_common():
        print(f"  {name:8} {count / sum(there.values()):6.1%} of the pixels, recall {right[name] / count:.2f}")
    print(f"compared in {seconds:.1f} s, {seconds / cast:.1f} times as long as the cast took ({cast:.1f} s)")


if __name__ == "__main__":
    tyro.cli(main)
