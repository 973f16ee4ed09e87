"""Features of photographs, and cameras as their lenses are known to be, in the database of COLMAP.

`sfm.py` imports this file beside it, after what pycolmap must not come before.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

CALIBRATED = "SIMPLE_PINHOLE"  # model of cameras whose focal length is known, as no others have
MIN_CALIBRATED = 10  # photographs needed to calibrate more than a focal length and a coefficient of distortion
_FOCAL = 0.8  # widths, as of phones: calibration finds less from COLMAP's 1.2
_CREDIBLE = 0.3, 10.0  # widths that EXIF may say, 11 to 360 mm on 35 mm film; 4 times the true one does no harm
_LARGE = 1300  # pixels of photographs that need no doubled image; of 29 of 1024 pixels along a street, all did


def extract(
    database: str,
    photographs: str,
    lenses: list[dict],
    rigs: list[list[dict]],
    masks: str | None,
    sift: dict,
    contrasts: dict[str, float],
    camera_model: str,
) -> None:
    """Extract features of all photographs that have none yet; each lens is one camera.

    Args:
        database: COLMAP's database.
        photographs: folder of the photographs.
        lenses: size and names of the photographs that share a camera, and its focal length in pixels, if it is known,
            or that to begin with, ``shrunk``, if it is not what EXIF says.
        rigs: cameras that move together: the prefix of their photographs' names, whose rest is the same for those that
            are taken at once, and the rotation from the first camera.
        masks: folder of masks, ``<name>.png``, black where no features are wanted; white ones are added for photographs
            without one, which COLMAP would leave out.
        sift: maximum image size, number of features, and first octave for large photographs: 0 skips the doubled image,
            which smaller photographs need.
        contrasts: contrast of each photograph relative to one by day: features of COLMAP have a least contrast, and at
            a fifth of the light one in 25 was left.
        camera_model: COLMAP's name of the model of lenses with enough photographs to calibrate it.
    """
    pycolmap.Database.open(database).close()  # makes it
    for lens in lenses:
        if masks:
            _add_white(Path(masks), lens["names"], lens["size"])
        reader = pycolmap.ImageReaderOptions(
            camera_model=camera_model if len(lens["names"]) >= MIN_CALIBRATED else "SIMPLE_RADIAL",
            mask_path=masks or "",
            default_focal_length_factor=_FOCAL,
        )
        if lens["focal"]:
            width, height = lens["size"]
            reader.camera_model = CALIBRATED
            reader.camera_params = f"{lens['focal']},{width / 2},{height / 2}"
        if camera := _camera_of(database, lens["names"]):
            reader.existing_camera_id = camera
        # Images have numbers in this order, on which the cameras found depend, not in that of threads that finish.
        pycolmap.import_images(
            database, photographs, pycolmap.CameraMode.SINGLE, image_names=lens["names"], options=reader
        )
        for contrast in sorted({contrasts[name] for name in lens["names"]}):
            options = pycolmap.FeatureExtractionOptions(max_image_size=sift["max_image_size"])
            options.sift.max_num_features = sift["max_num_features"]
            options.sift.first_octave = sift["first_octave"] if max(lens["size"]) >= _LARGE else -1
            options.sift.peak_threshold *= contrast
            pycolmap.extract_features(
                database,
                photographs,
                image_names=[name for name in lens["names"] if contrasts[name] == contrast],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
            )
    with pycolmap.Database.open(database) as opened:
        used = {image.name: image.camera_id for image in opened.read_all_images()}
        if unread := [name for lens in lenses for name in lens["names"] if name not in used]:
            raise OSError(f"COLMAP cannot read {unread[0]}: save it again as an ordinary JPEG or PNG, or leave it out")
        shrunk = {used[lens["names"][0]]: lens["shrunk"] for lens in lenses if lens.get("shrunk")}
        for camera in opened.read_all_cameras():
            if focal := shrunk.get(camera.camera_id):
                _begin_with(opened, camera, focal)
            _forget_absurd_focal(opened, camera)
        if rigs and not has_rigs(opened):
            pycolmap.apply_rig_config([rig_of(cameras) for cameras in rigs], opened)


def _camera_of(database: str, names: list[str]) -> int | None:
    """The camera of a lens, if some of its photographs have been read, perhaps by a run that was interrupted."""
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        cameras = {image.camera_id for image in images if image.name in names}
        # A camera is written before the features of its first photograph.
        unused = {camera.camera_id for camera in opened.read_all_cameras()} - {image.camera_id for image in images}
    return min(cameras or unused, default=None)


def _forget_absurd_focal(database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    """Let a camera's focal length be found where EXIF says what no camera has; some write millimetres of the sensor."""
    width, (low, high) = max(camera.width, camera.height), _CREDIBLE
    if camera.has_prior_focal_length and not low < camera.mean_focal_length() / width < high:
        camera.has_prior_focal_length = False
        _begin_with(database, camera, _FOCAL * width)


def _begin_with(database: pycolmap.Database, camera: pycolmap.Camera, focal: float) -> None:
    for k in camera.focal_length_idxs():
        camera.params[k] = focal
    database.update_camera(camera)


def _add_white(masks: Path, names: list[str], size: list[int]) -> None:
    """Write white masks for the photographs of a size that have none."""
    for target in (masks / f"{name}.png" for name in names):
        if not target.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            write_image(np.full(size[::-1], 255, np.uint8), target)


def has_rigs(database: pycolmap.Database) -> bool:
    """Whether some cameras move together."""
    return any(rig.num_sensors() > 1 for rig in database.read_all_rigs())


def rig_of(cameras: list[dict]) -> pycolmap.RigConfig:
    """Cameras that move together, as :func:`extract` takes them, as COLMAP does."""
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


def write_image(pixels: np.ndarray, target: Path) -> None:
    """Write an image by pycolmap, beside whose libpng Pillow's crashes."""
    if not pycolmap.Bitmap.from_array(pixels).write(target):
        raise OSError(f"{target} cannot be written")
