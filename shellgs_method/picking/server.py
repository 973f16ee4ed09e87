"""The page of a picking session and its answers, to this machine alone."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from inspect import signature
from pathlib import Path
from threading import Lock, Thread
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from PIL import Image

from shellgs_method.errors import SceneError, explained
from shellgs_method.files.html import encoded
from shellgs_method.files.photographs import load_upright, upright_size
from shellgs_method.picking.scan import Scan
from shellgs_method.picking.session import Session

_PAGE = Path(__file__).with_name("page.html")
_DECODED = 8  # photographs kept in memory
_FAR = 1e12  # no coordinate or pixel is farther from its origin
_STEPS = {
    "add": {"ray"},
    "move": {"name", "ray"},
    "mark": {"name", "view", "pixel"},
    "unmark": {"name", "view"},
    "remove": {"name"},
    "leave_out": {"name"},
    "rename": {"name", "new"},
    "select": {"name"},
    "undo": set[str](),
    "done": set[str](),
}
"""Steps that the page takes, and their arguments: those of the session, but rays for places in the scan."""


class PickServer(ThreadingHTTPServer):
    """The page's port on this machine, bound before a scan is read.

    Args:
        port: number of the port; 0 for a free one.

    Attributes:
        url: address of the page.
        session: the points.
        scan: what they are picked of.

    Raises:
        SceneError: the port is taken.
    """

    daemon_threads = True
    allow_reuse_address = False
    session: Session
    scan: Scan

    def __init__(self, port: int) -> None:
        self._lock = Lock()
        self._photograph = lru_cache(_DECODED)(lambda k: load_upright(self.session.views[k]))
        self._number = time.time_ns()  # in the addresses of images, which browsers keep
        try:
            super().__init__(("127.0.0.1", port), _Answers)
        except (OSError, OverflowError) as error:
            raise SceneError(f"port {port} cannot be used, it may be taken: give another with --port") from error
        self.url = f"http://127.0.0.1:{self.server_port}"

    def serve(self, session: Session, scan: Scan) -> None:
        """Answer until the user is done."""
        self.session, self.scan = session, scan
        self.serve_forever()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Images that the page no longer waits for are no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)

    def about(self) -> dict[str, Any]:
        """What the page shows and does not change."""
        scan, views = self.scan, self.session.views
        about = {"size": scan.size, "up": scan.up, "out": scan.out, "spacing": scan.cloud.spacing if scan.cloud else 0}
        photographs = [(view.name, *upright_size(view)) for view in views]
        return about | {"photographs": photographs, "server": self._number}

    def said(self) -> dict[str, Any]:
        """What the session says, with points placed as the scan is drawn."""
        said = self.session.said()
        return said | {"points": [{**point, "at": point["shell"] - self.scan.middle} for point in said["points"]]}

    def step(self, do: str, **values: Any) -> dict[str, Any]:
        """Take a step of the session and return what it says then.

        Args:
            do: one of the steps.
            values: its arguments; a ray is as :meth:`~shellgs_method.picking.scan.Scan.pick` takes it.

        Raises:
            SceneError: the step cannot be taken, or the ray hits nothing.
            OSError: the file of picks cannot be written, and the step is not taken.
        """
        with self._lock:
            if "ray" in values:
                values["shell"] = self.scan.pick(*values.pop("ray"))
                if values["shell"] is None:
                    raise SceneError("there is nothing of the scan: click on its surface")
            if do == "done":
                Thread(target=self.shutdown).start()
            else:
                getattr(self.session, do)(**values)
            return self.said()

    def image(self, number: int, side: int = 0, left: int = 0, top: int = 0, width: int = 0) -> bytes:
        """A photograph as JPEG: whole, with its longer side at most ``side`` pixels, or a 4:3 part of it.

        Raises:
            SceneError: there is no such photograph or part, or the file cannot be read.
        """
        if number not in range(len(self.session.views)):
            raise SceneError(f"there is no photograph {number}: reload the page")
        image = self._photograph(number)
        longer = max(image.size)
        if side < 0 or not (width == 0 or 2 <= width <= longer) or max(abs(left), abs(top)) > 2 * longer:
            raise SceneError(f"photograph {number} has no such part: reload the page")
        if width:
            image = image.crop((left, top, left + width, top + width * 3 // 4))
        elif side:
            image = image.copy()
            image.thumbnail((side, side), Image.Resampling.BOX)
        return encoded(np.asarray(image), "JPEG")


@contextmanager
def _reading() -> Iterator[None]:
    """Refuse a request that cannot be read, which the page does not send."""
    try:
        yield
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise SceneError("the request is malformed: reload the page") from error


def _coloured(points: np.ndarray, colours: np.ndarray) -> bytes:
    """Points in single precision, each with the four bytes of its colour."""
    rows = np.empty(len(points), [("at", "<f4", 3), ("colour", "u1", 4)])
    rows["at"], rows["colour"] = points, colours
    return rows.tobytes()


def _numbers(values: Any, *shape: int) -> np.ndarray:
    numbers = np.array(values, np.float64)
    if numbers.shape != shape or not (np.abs(numbers) < _FAR).all():
        raise ValueError("not such finite numbers")
    return numbers


def _argument(name: str, value: Any) -> Any:
    if name == "ray":
        origin, direction, reach = value
        return _numbers(origin, 3), _numbers(direction, 3), float(_numbers(reach))
    if name == "pixel":
        return tuple(_numbers(value, 2).tolist())
    if not isinstance(value, str):
        raise TypeError(f"{name} is not text")
    return value


class _Answers(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: PickServer

    def parse_request(self) -> bool:
        """Refuse names of other sites, which they can let lead to this machine (DNS rebinding)."""
        if not super().parse_request():
            return False
        host, port = self.headers.get("Host", ""), self.server.server_port
        named = host if ":" in host else f"{host}:80"  # which browsers leave out
        if named in (f"127.0.0.1:{port}", f"localhost:{port}"):
            return True
        self.send_error(403, f"this page is at {self.server.url} only")
        return False

    def do_GET(self) -> None:
        try:
            self._get()
        except SceneError as error:
            self._answer_json({"error": str(error)}, 400)

    def _get(self) -> None:
        with _reading():
            url = urlsplit(self.path)
            query = dict(parse_qsl(url.query))
        scan = self.server.scan
        if url.path == "/":
            self._answer(_PAGE.read_bytes(), "text/html; charset=utf-8")
        elif url.path == "/about":
            self._answer_json(self.server.about())
        elif url.path == "/said":
            self._answer_json(self.server.said())
        elif url.path == "/vertices":
            self._answer(_coloured(scan.mesh.vertices, scan.mesh.colours) if scan.mesh else b"")
        elif url.path == "/faces":
            self._answer(scan.mesh.faces.astype("<u4").tobytes() if scan.mesh else b"")
        elif url.path == "/points":
            self._answer(_coloured(scan.cloud.points, scan.cloud.colours) if scan.cloud else b"")
        elif url.path == "/detail" and scan.cloud:
            with _reading():
                ball = _numbers([query[name] for name in ("x", "y", "z", "radius")], 4)
            self._answer(_coloured(*scan.cloud.detail(ball[:3], ball[3])))
        elif url.path == "/image":
            with _reading():
                part = {name: int(value) for name, value in query.items() if name != "server"}
                signature(self.server.image).bind(**part)
            self._answer(self.server.image(**part), "image/jpeg", "max-age=86400")
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        try:
            content = self._content()
            if self.headers.get("Content-Type") != "application/json":  # a form of another page cannot send this
                self.send_error(415)
                return
            with _reading():
                step = dict(json.loads(content))
                do = step.pop("do")
                if step.keys() != _STEPS[do]:
                    raise TypeError(f"{do} takes other arguments")
                values = {name: _argument(name, value) for name, value in step.items()}
            self._answer_json(self.server.step(do, **values))
        except SceneError as error:
            self._answer_json({"error": str(error)}, 400)
        except OSError as error:
            self._answer_json({"error": f"the step is not taken: {explained(error)}"}, 400)

    def _content(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch("[0-9]{1,5}", length):
            self.close_connection = True  # nobody knows where the next request begins
            raise SceneError("the request does not say its length, or is too long: reload the page")
        return self.rfile.read(int(length))

    def _answer_json(self, content: dict[str, Any], status: int = 200) -> None:
        text = json.dumps(content, default=np.ndarray.tolist)
        self._answer(text.encode(), "application/json", status=status)

    def _answer(
        self, content: bytes, kind: str = "application/octet-stream", cache: str = "no-store", status: int = 200
    ) -> None:
        self.send_response(status)
        for name, value in (("Content-Type", kind), ("Content-Length", str(len(content))), ("Cache-Control", cache)):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
