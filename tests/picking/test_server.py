"""The command and its answers, without a browser."""

from __future__ import annotations

import io
import json
import shutil
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.error import HTTPError, URLError

import numpy as np
import pytest
from PIL import Image
from scenes import views_of

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import project
from shellgs_method.picking.scan import Scan
from shellgs_method.picking.server import PickServer
from shellgs_method.picking.session import Session
from shellgs_method.registration.frames import ShellPlace
from shellgs_method.registration.picks import read_picks
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell


def post(url: str, kind: str = "application/json", **step: Any) -> Any:
    """Take a step; the answer of one that is refused is that, too."""
    request = urllib.request.Request(f"{url}/step", json.dumps(step).encode(), {"Content-Type": kind})
    try:
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)
    except HTTPError as error:
        return json.load(error) if error.code == 400 else error.code


def get(url: str, **numbers: float) -> bytes:
    with urllib.request.urlopen(url + "?" + "&".join(f"{name}={value}" for name, value in numbers.items())) as answer:
        return answer.read()


def asked(server: PickServer, path: str, body: str | None = None, **headers: str) -> tuple[int, Any]:
    """Status and answer of a request that no page sends; a body is posted."""
    connection = HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    own = {"Content-Type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET" if body is None else "POST", path, body, own)
    with connection.getresponse() as answer:
        content = answer.read()
        return answer.status, json.loads(content) if answer.status == 400 else content


@pytest.fixture
def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.fixture
def server(scene: Path) -> Iterator[PickServer]:
    views = views_of(scene)
    shell = scene / "shell/facade.ply"
    session, scan = Session(scene / "picks.txt", views), Scan([shell], ShellPlace(shell))
    with PickServer(0) as server:
        Thread(target=server.serve, args=(session, scan), daemon=True).start()
        get(f"{server.url}/about")  # it serves
        yield server
        server.shutdown()


def clicked(url: str, scene: Path, count: int = 4) -> None:
    """Pick vertices of the shell that two views see: by rays in the scan, and where they are in the photographs."""
    alignment, views = Alignment.load(scene / ALIGNMENT), views_of(scene)
    vertices = load_shell(scene / "shell/facade.ply").vertices
    middle = ShellPlace(scene / "shell/facade.ply").middle
    eye = np.linalg.solve(alignment.shell_to_scene, [*views[4].camera.position.tolist(), 1.0])[:3]
    picked: list[np.ndarray] = []
    for vertex in vertices[np.random.default_rng(0).permutation(len(vertices))]:
        direction = (vertex - eye) / np.linalg.norm(vertex - eye)
        seen = [view for view in (views[4], views[6]) if _shows(view, alignment.apply(vertex[None]))]
        if len(seen) < 2 or any(np.linalg.norm(vertex - other) < 1 for other in picked):
            continue
        said = post(url, do="add", ray=[(eye - middle).tolist(), direction.tolist(), 1e-5])
        if "error" in said or not np.array_equal(said["points"][-1]["shell"], vertex):
            continue  # hidden
        for view in seen:
            pixel = project(view.camera, alignment.apply(vertex[None]))[0][0].tolist()
            said = post(url, do="mark", name=said["active"], view=view.name, pixel=pixel)
        picked.append(vertex)
        if len(picked) == count:
            return
    raise AssertionError("too few vertices are seen")


def _shows(view: View, point: np.ndarray) -> bool:
    pixel, depth = project(view.camera, point)
    return bool(depth[0] > 0 and (pixel[0] > 0).all() and (pixel[0] < [view.camera.width, view.camera.height]).all())


def test_the_command_takes_picks_and_tells_the_next(scene: Path, shellgs: Callable[..., str], free_port: int):
    url, shell = f"http://127.0.0.1:{free_port}", scene / "shell/facade[cleaned].ply"
    shutil.copy(scene / "shell/facade.ply", shell)
    (scene / "my masks").mkdir()
    chosen = ("--masks-path", "my masks", "--metres-per-shell-unit", 1.0000006)

    def user() -> None:
        for _ in range(600):
            try:
                get(f"{url}/about")
                break
            except URLError:
                time.sleep(0.1)
        clicked(url, scene)
        post(url, do="done")

    thread = Thread(target=user, daemon=True)
    thread.start()
    said = shellgs("pick", scene, shell, "--picks", scene / "picks.txt", "--port", free_port, *chosen)
    thread.join()
    assert f"Pick in a browser: {url}" in said
    assert "4 of 4 picks are used; their residual is 0.00" in said
    options = "--metres-per-shell-unit 1.0000006 --masks-path 'my masks'"
    assert f"Next: shellgs align {scene} '{shell}' --picks {scene / 'picks.txt'} {options}" in said
    picks = scene / "picks.txt"
    picks.write_text(picks.read_text().replace("p1", "p1[/left]"))
    said = shellgs("align", scene, shell, "--picks", picks, *chosen)
    assert "4 of 4 picks are used" in said
    assert "p1[/left]" in said


def test_a_port_that_is_taken_is_refused(server: PickServer, scene: Path, shellgs: Callable[..., str]):
    said = shellgs("pick", scene, server.session.path.parent / "shell/facade.ply", "--port", server.server_port)
    assert said.startswith(f"refused: shellgs: port {server.server_port} cannot be used, it may be taken")


def test_picks_of_another_frame_are_refused(scene: Path, shellgs: Callable[..., str]):
    (scene / "picks.txt").write_text("1 2 3 4 5 frame_00001.png a\n7 2 3 4 5 frame_00002.png b\n")
    assert "are not in the frame of the shell" in shellgs(
        "pick", scene, scene / "shell/facade.ply", "--picks", scene / "picks.txt"
    )


def test_a_step_that_cannot_be_taken_changes_nothing(server: PickServer):
    clicked(server.url, server.session.path.parent, 3)
    before, text = server.session.state, server.session.path.read_text()
    assert "malformed" in post(server.url, do="_write")["error"]
    assert "nothing of the scan" in post(server.url, do="add", ray=[[0, 0, 99], [0, 0, 1], 0])["error"]
    assert "no point p9" in post(server.url, do="remove", name="p9")["error"]
    assert "not a photograph" in post(server.url, do="mark", name="p1", view="x.png", pixel=[1, 2])["error"]
    view = server.session.views[0].name
    assert "which has 48x32" in post(server.url, do="mark", name="p1", view=view, pixel=[48.5, 2])["error"]
    assert "cannot be the name" in post(server.url, do="rename", name="p1", new="\ud800")["error"]
    assert post(server.url, kind="text/plain", do="remove", name="p1") == 415  # what another site's form could send
    assert server.session.state is before
    assert server.session.path.read_text() == text


def test_the_page_gets_the_scan_relative_to_its_middle(server: PickServer):
    mesh = load_shell(server.session.path.parent / "shell/facade.ply")
    rows = np.frombuffer(get(f"{server.url}/vertices"), [("at", "<f4", 3), ("colour", "u1", 4)])
    points = rows["at"]
    assert not rows["colour"][:, 3].any()  # a shell without colours
    np.testing.assert_allclose(points + server.scan.middle, mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(np.frombuffer(get(f"{server.url}/faces"), "<u4").reshape(-1, 3), mesh.faces)


def test_images_are_whole_small_or_parts(server: PickServer):
    size = {
        (): (48, 32),
        (("side", 24),): (24, 16),
        (("left", -4), ("top", 10), ("width", 16)): (16, 12),
    }
    for numbers, expected in size.items():
        assert Image.open(io.BytesIO(get(f"{server.url}/image", number=3, **dict(numbers)))).size == expected
    part = np.asarray(Image.open(io.BytesIO(get(f"{server.url}/image", number=3, left=8, top=4, width=32))), float)
    with Image.open(server.session.views[3].image) as image:
        whole = np.asarray(image.convert("RGB"), float)
    assert np.abs(part - whole[4:28, 8:40]).mean() < 12  # JPEG


def test_the_page_is_whole(server: PickServer):
    """It loads nothing from elsewhere."""
    page = get(f"{server.url}/").decode()
    assert page.startswith("<!doctype html>")
    assert "://" not in page


def test_a_step_that_cannot_be_written_is_not_taken(server: PickServer):
    clicked(server.url, server.session.path.parent, 3)
    before, path = server.session.state, server.session.path
    server.session.path = path / "below" / "picks.txt"
    for step in ({"do": "remove", "name": "p1"}, {"do": "undo"}):
        said = post(server.url, **step)["error"]
        assert said.startswith("the step is not taken: ")
        assert said.endswith("cannot be used: not a directory")
        assert server.session.state is before
    server.session.path = path
    assert [point["name"] for point in post(server.url, do="remove", name="p1")["points"]] == ["p2", "p3"]
    assert [point["name"] for point in post(server.url, do="undo")["points"]] == ["p1", "p2", "p3"]
    assert len(read_picks(path, server.session.views)) == 3


NO_IMAGES = """
number=99
number=-1
number=x
number=nan
number=1&foo=1
number=1&side=-5
number=1&width=1e9
number=1&width=1000000000
number=1&width=0.5
number=1&width=1
number=1&width=9&left=10000000000000000000000
""".splitlines()
NO_STEPS = """
nonsense
[]
{}
7
null
{"do": []}
{"do": "fly"}
{"do": "undo", "name": "p1"}
{"do": "add"}
{"do": "add", "shell": [1, 2, 3]}
{"do": "move", "name": "p1", "shell": [1, 2, 3]}
{"do": "add", "ray": []}
{"do": "add", "ray": null}
{"do": "add", "ray": [[0, 0], [0, 0, 1], 0]}
{"do": "add", "ray": [[0, 0, 9], [0, 0, -1], NaN]}
{"do": "add", "ray": [[0, 0, 1e300], [0, 0, -1], 0]}
{"do": "add", "ray": [[0, 0, "x"], [0, 0, -1], 0]}
{"do": "add", "ray": [[0, 0, {}], [0, 0, -1], 0]}
{"do": "remove", "name": ["p1"]}
{"do": "remove", "name": null}
{"do": "rename", "name": "p1", "new": 3}
{"do": "mark", "name": "p1", "view": "VIEW", "pixel": [1]}
{"do": "mark", "name": "p1", "view": "VIEW", "pixel": [1, NaN]}
{"do": "mark", "name": "p1", "view": "VIEW", "pixel": [1, null]}
{"do": "mark", "name": "p1", "view": "VIEW", "pixel": 3}
""".splitlines()


@pytest.mark.parametrize("query", NO_IMAGES)
def test_an_image_that_is_not_there_is_refused(server: PickServer, capfd: Any, query: str):
    status, answer = asked(server, f"/image?{query}")
    assert (status, list(answer)) == (400, ["error"])
    assert "reload the page" in answer["error"]
    assert not capfd.readouterr().err


@pytest.mark.parametrize(
    "body", [*NO_STEPS, "\xff", 9999 * "[", f'{{"do": "add", "ray": [[0, 0, 1{999 * "0"}], [0, 0, 1], 0]}}']
)
def test_a_malformed_step_is_refused_and_changes_nothing(server: PickServer, capfd: Any, body: str):
    assert "error" not in post(server.url, do="add", ray=[[0, 0, 99], [0, 0, -1], 0])
    before = server.session.state
    body = body.replace("VIEW", server.session.views[0].name)
    assert asked(server, "/step", body) == (400, {"error": "the request is malformed: reload the page"})
    assert server.session.state is before
    assert post(server.url, do="undo")["points"] == []
    assert not capfd.readouterr().err


@pytest.mark.parametrize("length", ["abc", "-1", "1000000000000", "²"])
def test_a_step_of_no_length_is_refused(server: PickServer, capfd: Any, length: str):
    status, answer = asked(server, "/step", "{}", Content_Length=length)
    assert status == 400
    assert "does not say its length" in answer["error"]
    assert not capfd.readouterr().err


def test_only_the_names_of_this_machine_are_answered(server: PickServer):
    """The name of another site may lead here, and its page would then read and change the picks (DNS rebinding)."""
    port = server.server_port
    for host in (f"127.0.0.1:{port}", f"localhost:{port}"):
        assert asked(server, "/said", Host=host)[0] == 200
    others = (f"site.example:{port}", "site.example", "localhost", f"localhost:{port + 1}", f"localhost.x:{port}", "")
    for host in others:
        status, answer = asked(server, "/said", Host=host)
        assert (status, b"points" in answer) == (403, False)
        assert asked(server, "/step", '{"do": "undo"}', Host=host)[0] == 403


@pytest.mark.parametrize("numbers", ["x=1&y=2&z=3", "x=1&y=2&z=3&radius=1e300", "x=1&y=2&z=nan&radius=1"])
def test_a_detail_without_its_place_is_refused(server: PickServer, monkeypatch: pytest.MonkeyPatch, numbers: str):
    monkeypatch.setattr(server.scan, "cloud", object())  # nothing is asked of it
    assert asked(server, f"/detail?{numbers}") == (400, {"error": "the request is malformed: reload the page"})
