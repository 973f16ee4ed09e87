"""Structure from motion, one step at a time: a script, run in a process of its own.

A crash in COLMAP's C++ must not take the caller with it, and pycolmap does not live well with other libraries. The job
comes as a line of JSON on standard input; each line on standard output is progress, the last one the result. The
process ends with its parent, whose end closes standard input.
"""

# pycolmap 4.1 to 4.2 imported before zlib corrupts it: the next png that is written aborts.
import zlib  # noqa: F401  isort: skip

import json
import os
import sys
import threading
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

SEED = 0
_FEW = 10  # photographs: too few to calibrate OPENCV's four coefficients of distortion


def extract(database: str, photographs: str, lenses: list[dict], masks: str | None, sift: dict) -> None:
    """Features of all photographs that have none yet; each lens is one camera.

    Args:
        database: COLMAP's database.
        photographs: folder of the photographs.
        lenses: size and names of the photographs that share a camera.
        masks: folder of masks, ``<name>.png``, black where no features are wanted.
        sift: the size that photographs are reduced to, the number of features, and the first octave of photographs of
            a thousand pixels and more: 0 leaves out the doubled image, which smaller ones need.
    """
    for lens in lenses:
        options = pycolmap.FeatureExtractionOptions(max_image_size=sift["max_image_size"])
        options.sift.max_num_features = sift["max_num_features"]
        options.sift.first_octave = sift["first_octave"] if max(lens["size"]) >= 1000 else -1
        reader = pycolmap.ImageReaderOptions(
            camera_model="OPENCV" if len(lens["names"]) >= _FEW else "SIMPLE_RADIAL", mask_path=masks or ""
        )
        with pycolmap.Database.open(database) as opened:  # what an interrupted run left
            cameras = [image.camera_id for image in opened.read_all_images() if image.name in lens["names"]]
        if cameras:
            reader.existing_camera_id = cameras[0]
        pycolmap.extract_features(
            database,
            photographs,
            image_names=lens["names"],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )


def match(database: str, pairs: str) -> None:
    """Verified matches of the listed pairs that have none yet."""
    with pycolmap.Database.open(database) as opened:
        if opened.num_matched_image_pairs() > len(Path(pairs).read_text().splitlines()):  # of another way of pairing
            opened.clear_matches()
            opened.clear_two_view_geometries()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.match_image_pairs(
        database,
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pairs),
        verification_options=verification,
    )


def reconstruct(database: str, photographs: str, output: str) -> list[dict]:
    """Cameras and points by incremental mapping; the largest model is written, all are described, largest first."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, min_model_size=3)
    models = pycolmap.incremental_mapping(
        database, photographs, output, options, next_image_callback=lambda: print(flush=True)
    )
    ranked = sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if ranked:
        ranked[0].write(output)
    return [
        {
            "names": sorted(model.image(i).name for i in model.reg_image_ids()),
            "points": model.num_points3D(),
            "reprojection_error": model.compute_mean_reprojection_error(),
            "track_length": model.compute_mean_track_length(),
        }
        for model in ranked
    ]


def undistort(model: str, photographs: str, masks: str | None, output: str) -> None:
    """Photographs, masks and model of pinhole cameras.

    Masks are named as nerfstudio's COLMAP dataparser looks for them, and there is one for every photograph.
    """
    pycolmap.undistort_images(output, model, photographs, jpeg_quality=95)
    if masks is None:
        return
    reconstruction = pycolmap.Reconstruction(model)
    for image in (reconstruction.image(i) for i in reconstruction.reg_image_ids()):
        camera, path = reconstruction.camera(image.camera_id), Path(masks) / f"{image.name}.png"
        mask = np.asarray(Image.open(path)) if path.is_file() else np.full((camera.height, camera.width), 255, np.uint8)
        bitmap, _ = pycolmap.undistort_image(
            pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(mask), camera
        )
        target = (Path(output) / "masks" / image.name).with_suffix(".png")
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.where(bitmap.to_array().squeeze() > 127, 255, 0).astype(np.uint8)).save(target)


def main() -> None:
    """Do the job on standard input."""
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    step = {"extract": extract, "match": match, "reconstruct": reconstruct, "undistort": undistort}[job.pop("step")]
    print(json.dumps(step(**job)), flush=True)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
