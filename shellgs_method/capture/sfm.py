"""One step of structure from motion: a script that runs in its own process.

A crash in COLMAP's C++ must not end the caller, and pycolmap conflicts with other libraries. The job is one line of
JSON on standard input; each line on standard output is progress, the last one the result. The process ends with its
parent, whose end closes standard input. Images are read and written by pycolmap, beside whose libpng Pillow's crashes.
"""

# pycolmap 4.1 to 4.2 imported before zlib corrupts it: the next png that is written aborts.
import zlib  # noqa: F401  isort: skip

import json
import os
import shutil
import sys
import threading
from pathlib import Path

import numpy as np
import pycolmap

SEED = 0
_RIGID_DEGREES, _RIGID_STEPS = 3.0, 0.5  # most that cameras which are mounted together move against each other
_CALIBRATED = "SIMPLE_PINHOLE"  # model of cameras whose focal length is known, as no others have
_MIN_OPENCV = 10  # photographs needed to calibrate OPENCV's four distortion coefficients


def extract(
    database: str, photographs: str, lenses: list[dict], rigs: list[list[dict]], masks: str | None, sift: dict
) -> None:
    """Extract features of all photographs that have none yet; each lens is one camera.

    Args:
        database: COLMAP's database.
        photographs: folder of the photographs.
        lenses: size and names of the photographs that share a camera, and its focal length in pixels, if it is known.
        rigs: cameras that move together: the prefix of their photographs' names, whose rest is the same for those that
            are taken at once, and the rotation from the first camera.
        masks: folder of masks, ``<name>.png``, black where no features are wanted.
        sift: maximum image size, number of features, and first octave for photographs of 1000 pixels and more: 0 skips
            the doubled image, which smaller photographs need.
    """
    for lens in lenses:
        options = pycolmap.FeatureExtractionOptions(max_image_size=sift["max_image_size"])
        options.sift.max_num_features = sift["max_num_features"]
        options.sift.first_octave = sift["first_octave"] if max(lens["size"]) >= 1000 else -1
        reader = pycolmap.ImageReaderOptions(
            camera_model="OPENCV" if len(lens["names"]) >= _MIN_OPENCV else "SIMPLE_RADIAL", mask_path=masks or ""
        )
        if lens["focal"]:
            width, height = lens["size"]
            reader.camera_model = _CALIBRATED
            reader.camera_params = f"{lens['focal']},{width / 2},{height / 2}"
        with pycolmap.Database.open(database) as opened:  # may hold the results of an interrupted run
            images = opened.read_all_images()
            cameras = {image.camera_id for image in images if image.name in lens["names"]}
            # A camera is written before the features of its first photograph.
            unused = {camera.camera_id for camera in opened.read_all_cameras()} - {image.camera_id for image in images}
        if cameras or unused:
            reader.existing_camera_id = min(cameras or unused)
        pycolmap.extract_features(
            database,
            photographs,
            image_names=lens["names"],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )
    with pycolmap.Database.open(database) as opened:
        if rigs and not _has_rigs(opened):
            pycolmap.apply_rig_config([_rig(cameras) for cameras in rigs], opened)


def _has_rigs(database: pycolmap.Database) -> bool:
    return any(rig.num_sensors() > 1 for rig in database.read_all_rigs())


def _rig(cameras: list[dict]) -> pycolmap.RigConfig:
    configs = []
    for number, camera in enumerate(cameras):
        config = pycolmap.RigConfigCamera()
        config.ref_sensor, config.image_prefix = number == 0, camera["prefix"]
        if number and "rotation" in camera:
            config.cam_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(camera["rotation"])), np.zeros(3))
        configs.append(config)
    rig = pycolmap.RigConfig()
    rig.cameras = configs
    return rig


def match(database: str, pairs: str) -> None:
    """Match and verify the listed pairs that have no matches yet."""
    with pycolmap.Database.open(database) as opened:
        if opened.num_matched_image_pairs() > len(Path(pairs).read_text().splitlines()):  # from other settings
            opened.clear_matches()
            opened.clear_two_view_geometries()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    with pycolmap.Database.open(database) as opened:
        has_rigs = _has_rigs(opened)
    pycolmap.match_image_pairs(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(rig_verification=has_rigs),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pairs),
        verification_options=verification,
    )


def reconstruct(database: str, photographs: str, output: str) -> list[dict]:
    """Run incremental mapping and write the largest model; return a description of all models, largest first."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, min_model_size=3)
    with pycolmap.Database.open(database) as opened:
        known = {camera.camera_id for camera in opened.read_all_cameras() if camera.model.name == _CALIBRATED}
        options.constant_cameras = known
        options.constant_rigs = {rig.rig_id for rig in opened.read_all_rigs() if rig.ref_sensor_id.id in known}
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


def mount(database: str, photographs: str, model: str, prefixes: list[str]) -> dict:
    """Find how cameras of a rig are mounted from a model of each for itself, and all again as a rig.

    Args:
        database: COLMAP's database, which is changed.
        photographs: folder of the photographs.
        model: folder of the model, which is replaced.
        prefixes: what the names of each camera's photographs begin with.

    Returns:
        ``models``, as :func:`reconstruct`; or ``loose``: the prefix of a camera that is not mounted with the first one,
        and how it moved against it, in degrees and in steps from one shot to the next, the medians.
    """
    single = pycolmap.Reconstruction(model)
    poses = {image.name: image.cam_from_world() for image in (single.image(i) for i in single.reg_image_ids())}
    first = [poses[name] for name in sorted(poses) if name.startswith(prefixes[0])]
    path = np.array([pose.inverse().translation for pose in first]).reshape(-1, 3)
    step = np.median(np.linalg.norm(np.diff(path, axis=0), axis=1)) if len(path) > 1 else 0.0
    for prefix in prefixes[1:]:
        of_first = {name: prefixes[0] + name.removeprefix(prefix) for name in poses if name.startswith(prefix)}
        mounted = [poses[name] * poses[other].inverse() for name, other in of_first.items() if other in poses]
        if len(mounted) < 2:
            return {"loose": [prefix, None, None]}
        turned = np.degrees(min(np.median([a.rotation.angle_to(b.rotation) for b in mounted]) for a in mounted))
        at = np.array([pose.inverse().translation for pose in mounted])
        moved = np.median(np.linalg.norm(at - np.median(at, axis=0), axis=1)) / max(step, 1e-12)
        if turned > _RIGID_DEGREES or moved > _RIGID_STEPS:
            return {"loose": [prefix, float(turned), float(moved)]}
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([_rig([{"prefix": prefix} for prefix in prefixes])], opened, single)
    for numbered in filter(Path.is_dir, Path(model).iterdir()):
        shutil.rmtree(numbered)
    return {"models": reconstruct(database, photographs, model)}


def undistort(model: str, photographs: str, masks: str | None, output: str) -> None:
    """Write undistorted photographs and masks and the model of their pinhole cameras.

    Masks are named as nerfstudio's COLMAP dataparser expects, and every photograph gets one.
    """
    pycolmap.undistort_images(output, model, photographs, jpeg_quality=95)
    if masks is None:
        return
    reconstruction = pycolmap.Reconstruction(model)
    for image in (reconstruction.image(i) for i in reconstruction.reg_image_ids()):
        camera, path = reconstruction.camera(image.camera_id), Path(masks) / f"{image.name}.png"
        bitmap, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), _mask(path, camera), camera)
        target = (Path(output) / "masks" / image.name).with_suffix(".png")
        target.parent.mkdir(parents=True, exist_ok=True)
        kept = np.where(bitmap.to_array().squeeze() > 127, 255, 0).astype(np.uint8)
        if not pycolmap.Bitmap.from_array(kept).write(target):
            raise OSError(f"{target} cannot be written")


def _mask(path: Path, camera: pycolmap.Camera) -> pycolmap.Bitmap:
    """A mask; white where there is no file."""
    if not path.is_file():
        return pycolmap.Bitmap.from_array(np.full((camera.height, camera.width), 255, np.uint8))
    if (mask := pycolmap.Bitmap.read(path, as_rgb=False)) is None:
        raise OSError(f"{path} cannot be read")
    return mask


def main() -> None:
    """Run the job given on standard input."""
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    steps = extract, match, reconstruct, mount, undistort
    step = {step.__name__: step for step in steps}[job.pop("step")]
    print(json.dumps(step(**job)), flush=True)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
