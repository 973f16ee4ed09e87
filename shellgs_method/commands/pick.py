"""`shellgs pick`: points clicked in the scan and in photographs."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Optional

import tyro

from shellgs_method.bounds import Length, Port, bounded
from shellgs_method.commands.common import PATHS, Paths, Scene, console, required, shell_words, warn
from shellgs_method.errors import SceneError


@bounded
def pick(
    scene: Scene,
    shell: Annotated[tuple[Path, ...], tyro.conf.Positional, required(metavar="SHELL [SHELL ...]")],
    picks: Path = Path("picks.txt"),
    metres_per_shell_unit: Optional[Length] = None,
    crs: Optional[str] = None,
    port: Port = 7070,
    open: bool = False,
    paths: Paths = PATHS,
) -> None:
    """Pick points in the scan and in photographs, side by side in the browser, for `shellgs align --picks`.

    Each click is saved in the file of picks. Run the same command again to continue.

    Args:
        scene: Scene folder.
        shell: Mesh, model (IFC, CityGML, CityJSON) or point cloud of the shell; or several, in the same coordinates.
        picks: File of picks, written and read back.
        metres_per_shell_unit: Length of the shell's unit in metres. If not set: that of its coordinate reference
            system, else a metre.
        crs: Coordinate reference system of the shell, such as EPSG:25832, to which a file of picks in another one is
            converted. If not set: as the shell's file says, or a .prj beside it.
        port: Port of the page.
        open: Open the page in a browser.
        paths: Paths of the scene's files.
    """
    import webbrowser

    from shellgs_method.machine.progress import tell

    tell("Reading the scene")
    import numpy as np

    from dataparsers.facade import read_views
    from shellgs_method.errors import check_output
    from shellgs_method.picking.scan import Scan
    from shellgs_method.picking.server import PickServer
    from shellgs_method.picking.session import Session
    from shellgs_method.registration.align import system_and_unit
    from shellgs_method.registration.frames import ShellPlace

    if not shell:
        raise SceneError(f"name the shell's file: shellgs pick {shlex.quote(str(scene))} scan.ply")
    check_output(picks)
    picks.parent.mkdir(parents=True, exist_ok=True)
    views = read_views(paths.of(scene).unadjusted())
    if len(views) < 2:
        raise SceneError(f"{scene} has {len(views)} photograph, and a point is picked in two or more")
    with PickServer(port) as server:
        tell(f"Reading {', '.join(path.name for path in shell)}")
        place = ShellPlace(*shell)
        system, unit = system_and_unit(shell, crs, metres_per_shell_unit, scene)
        session = Session(picks, views, unit, system)
        if session.state.picks:
            place.check_picks(np.stack([point.shell for point in session.state.picks]), f"the picks of {picks}")
        tell("Preparing it to be drawn and picked")
        scan = Scan(shell, place)
        console.print(f"Pick in a browser: {server.url} (Ctrl-C or the page's button ends it).")
        if open:
            webbrowser.open(server.url)
        with suppress(KeyboardInterrupt):
            server.serve(session, scan)
    said = session.said()
    for point in said["points"]:
        if point["problem"] and not point["left_out"]:
            warn(f"{point['problem']}.", soft_wrap=True)
    fit = said["fit"]
    if "problem" in fit:
        console.print(f"{picks}: {fit['problem']}. The same command continues.", soft_wrap=True)
        return
    words = [scene, *shell, "--picks", picks, *shell_words(metres_per_shell_unit, crs)]
    align = f"shellgs align {shlex.join(map(str, words))}{paths.flags}"
    console.print(f"{fit['words']}\nNext: {align}", soft_wrap=True)
