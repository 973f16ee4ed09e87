"""Export trained runs to a folder that simulators load."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np

from shellgs_method.datamanager import FacadeDataManagerConfig
from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.atomic import atomic_contents, files_in, read_json, write_whole
from shellgs_method.files.splats import write_splats
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.machine.progress import tell
from shellgs_method.runs.run_folder import open_run
from shellgs_method.sim.building import Reconstruction
from shellgs_method.sim.collision.collider import GROUND, LEAKY, Collider, Leaks, leaks, make_collider, standing_before
from shellgs_method.sim.collision.distances import both_ways
from shellgs_method.sim.collision.outside import from_outside
from shellgs_method.sim.collision.parts import pieces
from shellgs_method.sim.deviations import Deviations, find_deviations
from shellgs_method.sim.formats.asset import Asset, write_parts
from shellgs_method.sim.formats.readme import write_readme
from shellgs_method.sim.formats.usd import write_usd_asset
from shellgs_method.sim.formats.world import write_asset, write_world
from shellgs_method.sim.frame import FRAME
from shellgs_method.sim.free_space import FreeSpace
from shellgs_method.sim.ground import STEP, Ground
from shellgs_method.sim.look.texture import bake
from shellgs_method.sim.look.visual import without_specks, write_visual
from shellgs_method.sim.report import Chapter, write_report
from shellgs_method.sim.settings import SimSettings
from shellgs_method.sim.trials.engine import import_mujoco
from shellgs_method.sim.workspace import Workspace

AHEAD = 0.05
"""Distance in metres from which the fused surface is in front of the shell, or two voxels if that is more."""
RESERVED = ("world", "site", "ground", "physics", "light", "sun", "friction", "package")
"""Names of parts of a world, in one format or another, and of an asset's file that is another's, ``package.xml``."""
OUTDATED = "facade.xml"
"""A file that version 0.2.0 wrote, which knew no folder for each building."""
MAX_GAP = 2.0
"""Gap in metres from which the pieces of a building's collision geometry are reported as separate."""


def simulate(
    configs: Sequence[Path],
    out: Path,
    settings: SimSettings,
    log: Callable[[str], None] = print,
) -> tuple[dict, list[Chapter]]:
    """Export the buildings of trained runs to one folder that simulators load.

    The folder stays as it was until all is written; files of an earlier world are removed then, and no others.

    Args:
        configs: config.yml of each run; the first run's frame is the world's.
        out: output folder.
        settings: export settings.
        log: called with each message for the user.

    Returns:
        The metrics of ``metrics.json``, and the chapters that they were computed from.

    Raises:
        SceneError: a run cannot be used, the runs have no common frame, or the folder has other files.
    """
    if not configs or out.suffix in (".yml", ".yaml") or out.is_file():
        raise SceneError(f"give the config.yml of at least one run, then an output folder (last was {out})")
    if (out / OUTDATED).exists():
        raise SceneError(
            f"{out} is of an earlier version, whose files ({OUTDATED} and others) would stay beside the new ones: "
            "remove it, or give another folder"
        )
    earlier = _earlier_files(out)
    import_mujoco()  # fail before hours of work
    with atomic_contents(out) as folder:
        metrics, chapters = _world(configs, folder, settings, log)
        record, files = read_json(folder / FRAME), [path.as_posix() for path in files_in(folder)]
        (folder / FRAME).write_text(json.dumps({**record, "files": files}, indent=1) + "\n")
    for path in (out / name for name in set(earlier) - set(files)):
        path.unlink(missing_ok=True)
        for parent in path.relative_to(out).parents[:-1]:
            with suppress(OSError):  # the user has something there
                (out / parent).rmdir()
    return metrics, chapters


def _earlier_files(out: Path) -> list[str]:
    """Paths of the files of an earlier world in a folder, as far as they are known.

    Raises:
        SceneError: the folder has files, and is not one of a world.
    """
    if not out.is_dir() or not any(not path.name.startswith(".") for path in out.iterdir()):
        return []
    if not (out / FRAME).is_file():
        raise SceneError(f"{out} has other files: give a new folder, or one that `shellgs sim` wrote")
    files = read_json(out / FRAME).get("files", [])
    plain = [name for name in files if isinstance(name, str) and not Path(name).is_absolute() and ".." not in name]
    return plain if len(plain) == len(files) else []


def _world(
    configs: Sequence[Path],
    out: Path,
    settings: SimSettings,
    log: Callable[[str], None],
) -> tuple[dict, list[Chapter]]:
    """Write the files of :func:`simulate`."""
    _refuse_twice(configs)  # before hours of work
    names: list[str] = []
    chapters, home = [], None
    for config in configs:
        run = TrainedRun.load(config)
        made = Reconstruction.of(run, settings.faces, settings.voxel, settings.ground, home)
        home = home or made.frame
        made.warn_if_unaligned(log)
        names.append(_name(made.scene if len(configs) > 1 else settings.name, names))
        chapters.append(_building(made, out / names[-1], settings, log))
    assert home is not None
    assets = [chapter.asset for chapter in chapters]
    ground = _common_ground([chapter.made for chapter in chapters])
    log(str(ground) if settings.ground is None else f"The ground is level, at {settings.ground:g}, as given.")
    tell("Writing the world")
    for chapter in chapters:
        _report_steps(chapter.made, ground, log)
    trusted = _trusted([chapter.made for chapter in chapters])
    parts = [part.vertices for chapter in chapters for part in chapter.collider.parts]
    ground = ground.under(np.concatenate([*parts, trusted.eyes]))
    write_world(out, assets, home, ground)
    buildings = {name: chapter.made.scene for name, chapter in zip(names, chapters, strict=True)}
    home.write(out, {"buildings": buildings, "trusted": trusted.facts})
    paths = trusted.eyes[:, :2]
    FreeSpace.of(parts, ground, paths).write(out, paths)
    tell("Testing and rendering in MuJoCo" if settings.test else "Rendering in MuJoCo")
    metrics = write_report(out, chapters, ground, settings.test, log)
    write_readme(out, assets, home, ground, metrics)
    write_whole(out / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    return metrics, chapters


def _refuse_twice(configs: Sequence[Path]) -> None:
    """Refuse runs of the same building."""
    places: dict[tuple[Path, str | None], Path] = {}
    for config in configs:
        manager = open_run(config).pipeline.datamanager
        if isinstance(manager, FacadeDataManagerConfig) and manager.data is not None:
            place = manager.data.resolve(), manager.dataparser.block  # pyright: ignore[reportAttributeAccessIssue]
            if place in places:
                raise SceneError(f"{places[place]} and {config} are runs of the same building: give one of them")
            places[place] = config


def _building(made: Reconstruction, folder: Path, settings: SimSettings, log: Callable[[str], None]) -> Chapter:
    """Write the files of one building, to a folder of its name."""
    folder.mkdir(parents=True, exist_ok=True)
    ahead = max(AHEAD, 2 * made.fused.metadata["voxel"]) if made.frame.metric else 2 * made.fused.metadata["voxel"]
    eyes = made.eyes
    fused, seen = outward(Triangles(made.fused.vertices, made.fused.faces), eyes)
    ground = made.ground
    low = ground.at(fused.centres) + GROUND
    shell, outside, standing, beside = None, None, seen & (fused.centres[:, 2] > low), np.zeros(len(seen), bool)
    if made.shell is not None:
        shell, outside = from_outside(made.shell, eyes)
        outside &= ~ground.has(shell)
        standing = standing_before(shell, fused, eyes, ahead, ground)
        beside = (shell.signed_distance(fused.centres) > ahead) & ~standing
    tell("Making the collision geometry")
    collider = make_collider(shell, fused, standing, outside, settings.parts)
    # The reconstruction continues beside the shell's outline and below its foot: leave that out from here on.
    mesh = made.fused
    mesh.update_faces(~beside)
    mesh.remove_unreferenced_vertices()
    fused, _ = outward(Triangles(mesh.vertices, mesh.faces), eyes)
    _report_gaps(collider, made.scene, log)
    leaking = leaks(collider.surface, shell or fused, eyes)
    _report_leaks(leaking, made, log)
    write_parts(folder, collider.parts)
    colours = np.asarray(mesh.visual.vertex_colors[:, :3], np.float64)  # pyright: ignore
    tell("Baking the texture")
    textured = bake(fused, colours, made.photos, settings.texel)
    classes = without_specks(textured, made.classes_at(textured.vertices[textured.faces].mean(axis=1)))
    facts = write_visual(folder, textured, classes, settings.megabytes)
    write_splats(folder / "splats.ply", made.splats)
    asset = Asset(folder.name, len(collider.parts), [SurfaceClass(each) for each in np.unique(classes)])
    write_asset(folder, asset)
    write_usd_asset(folder, asset.name, textured, classes, collider.parts, made.splats, made.frame.metric)
    deviations: Deviations | None = None
    if shell is not None:
        views = [(view.name, camera) for view, camera in zip(made.views, made.cameras, strict=True)]
        of = {"classes": made.classes, "sources": made.sources, "files": made.files}
        tell("Looking for deviations from the shell")
        deviations = find_deviations(shell, fused, views, ahead, made.contradicted, **of)
        deviations.write(folder / "deviations.ply")
        regions = [asdict(region) for region in deviations.regions]
        write_whole(folder / "deviations.json", json.dumps(regions, indent=1) + "\n")
    tell("Measuring the collision geometry")
    surfaces = ({} if shell is None else {"shell": shell}) | {"fused surface": fused}
    distances = {
        name: both_ways(collider.surface, other, shell, made.cameras, ahead) for name, other in surfaces.items()
    }
    return Chapter(asset, made, shell, collider, leaking, facts, deviations, distances)


def _report_gaps(collider: Collider, scene: str, log: Callable[[str], None]) -> None:
    """Report collision geometry in pieces that are far from each other."""
    if (count := pieces(collider.parts, MAX_GAP)) > 1:
        log(f"The collision geometry of {scene} is in {count} pieces, more than {MAX_GAP:g} m apart.")


def _report_leaks(found: Leaks, made: Reconstruction, log: Callable[[str], None]) -> None:
    """Report a hole in the collision geometry."""
    if found.share > LEAKY and found.place is not None:
        x, y, z = found.place
        log(
            f"{found.share:.1%} of the camera rays to {made.scene} pass its collision geometry, most of them at "
            f"{x:.1f} {y:.1f} {z:.1f} m, seen in {made.views[found.eye].name}: bodies may get through there."
        )


def _common_ground(buildings: Sequence[Reconstruction]) -> Ground:
    """The ground of a world, by the points of all its buildings."""
    if len(buildings) == 1:
        return buildings[0].ground
    points, eyes = ([getattr(made, name) for made in buildings] for name in ("ground_points", "eyes"))
    return Ground.of(np.concatenate(points), np.concatenate(eyes))


def _trusted(buildings: Sequence[Reconstruction]) -> Workspace:
    """The workspace where the splats of all buildings are to be believed."""
    cameras = [camera for made in buildings for camera in made.cameras]
    eyes, directions = positions(cameras), np.array([camera.viewmat[2, :3].double().numpy() for camera in cameras])
    surfaces = [Triangles(made.fused.vertices, made.fused.faces) for made in buildings]
    distances = [np.linalg.norm(surface.closest(eyes).point - eyes, axis=1) for surface in surfaces]
    return Workspace.around(eyes, directions, np.min(distances, axis=0))


def _report_steps(made: Reconstruction, ground: Ground, log: Callable[[str], None]) -> None:
    """Report a building that does not stand on the ground of its world."""
    below = float(np.median(made.ground.at(made.eyes) - ground.at(made.eyes)))
    if abs(below) > STEP:
        log(
            f"The ground of the world is {abs(below):.1f} m {'below' if below > 0 else 'above'} that in front of "
            f"{made.scene}: the buildings stand at different heights, and only one street is measured. Export them "
            "one by one."
        )


def _name(scene: str, taken: Sequence[str]) -> str:
    """A unique name for a building that is valid in XML, USD and file systems, and no part of a world."""
    name = re.sub(r"\W", "_", scene, flags=re.ASCII)
    name = name if re.match(r"[A-Za-z]", name) and name.lower() not in RESERVED else f"building_{name}"
    lower = [other.lower() for other in taken]
    return next(made for made in (name, *(f"{name}_{k}" for k in range(2, 100))) if made.lower() not in lower)
