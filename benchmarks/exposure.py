"""What exposure and white balance that change along the walk cost a method: runs with them against runs without.

python -m benchmarks.exposure outputs/exposure --scene scenes/synthetic --method shellgs-metric
python -m benchmarks.exposure outputs/exposure --scene scenes/herz-jesu-p25 --method photo-gs --exposure fixed
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float64
from numpy import ndarray
from PIL import Image

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.compare.measure import measure
from shellgs_method.files.atomic import unfinished
from shellgs_method.files.photographs import read_image
from shellgs_method.files.transfer import linear_of, srgb
from shellgs_method.synthetic.appearance import developed, exposed, log_gains
from shellgs_method.synthetic.scene import Facade, FacadeConfig, settings_of
from shellgs_method.synthetic.site import generators

GOALS = {"cc_psnr_seen": 0.3, "chamfer_m": 0.002, "f_score_5cm": 0.005}
"""Differences that are wanted at most between a run with changing light and one without."""
SHOWN = ("psnr_seen", "cc_psnr_seen", "cc_psnr_on_shell", "cc_psnr_before_shell", "chamfer_m", "f_score_5cm")


def main(
    work: Annotated[Path, tyro.conf.Positional],
    scene: Path,
    method: str = "shellgs-metric",
    exposure: Literal["learned", "fixed"] = "learned",
    iterations: int = 750,
    seeds: tuple[int, ...] = (0,),
    only: Literal["both", "constant", "changing"] = "both",
    more: tuple[str, ...] = (),
) -> None:
    """Train a method on a scene and on the same scene in changing light, and print the difference of their metrics.

    Args:
        work: folder for the scene in changing light and the runs.
        scene: a prepared scene: `shellgs cast` was run.
        method: method to train.
        exposure: whether it learns exposures.
        iterations: length of the runs.
        seeds: seeds of the runs.
        only: train only on one of the two scenes.
        more: more words for ns-train.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if not (scene / "cues/checked").exists():  # which the scene in changing light has
        raise SystemExit(f"the photographs of {scene} were not compared with its shell: run `shellgs cast` on it")
    changing = work / "scenes" / scene.name
    if only != "constant" and not changing.exists():
        write_in_changing_light(scene, changing)
        size = json.loads((scene / "cues/shell/manifest.json").read_text())["max_image_size"]
        words = ["--max-image-size", str(size)] if size else []
        subprocess.run(["shellgs", "cast", str(changing), *words], check=True)
    scenes = {"constant": scene, "changing": changing}
    means = {}
    for light, data in scenes.items():
        if only in ("both", light):
            runs = [_metrics(work, light, data, method, exposure, iterations, seed, more) for seed in seeds]
            means[light] = {key: np.array([run[key] for run in runs]) for key in SHOWN if key in runs[0]}
            print(f"{scene.name}, {method}, exposure {exposure}, {light} light, {iterations} iterations", *more)
            for key, values in means[light].items():
                print(f"  {key:22} {values.mean():8.4f} ± {values.std(ddof=1) if len(values) > 1 else 0:.4f}")
    if len(means) == 2:
        for key, goal in GOALS.items():
            difference = means["changing"][key].mean() - means["constant"][key].mean()
            print(f"  {key:22} {difference:+.4f}, goal {goal} at most")


def write_in_changing_light(scene: Path, target: Path) -> None:
    """Copy a scene; of its photographs, the synthetic facade's are taken again, others are changed in linear light."""
    copy = unfinished(target)
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("checked"))
    views = read_views(FacadeDataParserConfig(data=copy))
    gains = np.exp(log_gains(len(views)))
    if (scene / "facade.json").exists():
        config = FacadeConfig(**settings_of(scene))
        facade, sensor = Facade.build(config), generators(config.seed + 1, 3)[0]
        images = [
            developed(gain * exposed(facade.daylight, camera, config.supersampling), sensor)
            for gain, camera in zip(gains, facade.cameras, strict=True)
        ]
    else:
        images = [_changed(np.asarray(read_image(v.image)), gain) for v, gain in zip(views, gains, strict=True)]
    for view, image in zip(views, images, strict=True):
        view.image.unlink()  # it may be a link
        Image.fromarray(image).save(view.image, quality=98, subsampling=0)
    copy.rename(target)


def _changed(image: ndarray, gain: Float64[ndarray, " 3"]) -> ndarray:
    """A photograph under a gain before its sRGB curve, clipping and 8 bits."""
    stored = srgb((gain * linear_of(image / 255)).clip(0, 1))
    return (255 * stored).round().astype(np.uint8)


def _metrics(
    work: Path, light: str, data: Path, method: str, exposure: str, iterations: int, seed: int, more: tuple[str, ...]
) -> dict[str, float]:
    """Metrics of a run, which is trained if it was not yet."""
    name = "-".join([light, method, exposure, str(iterations), *(word.strip("-") for word in more)])
    folder = work / data.name / name / method / f"seed-{seed}"
    if not any(folder.glob("nerfstudio_models/*.ckpt")):
        words = ["ns-train", method, "--data", data, "--output-dir", work, "--experiment-name", f"{data.name}/{name}"]
        words += ["--timestamp", f"seed-{seed}", "--max-num-iterations", iterations, "--machine.seed", seed]
        words += ["--vis", "tensorboard", "--pipeline.model.exposure", exposure, "--steps-per-eval-image", 0, *more]
        subprocess.run(list(map(str, words)), check=True, stdout=subprocess.DEVNULL)
    return measure(folder / "config.yml")["results"]


if __name__ == "__main__":
    tyro.cli(main)
