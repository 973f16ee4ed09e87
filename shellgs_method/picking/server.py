"""The page of a picking session and its answers, to this machine alone."""

from __future__ import annotations

import json
import sys
import time
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from PIL import Image

from shellgs_method.errors import SceneError, explained
from shellgs_method.files.html import encoded
from shellgs_method.files.photographs import load_upright, upright_size
from shellgs_method.picking.scan import Scan
from shellgs_method.picking.session import Session

_PAGE = Path(__file__).with_name("page.html")
_DECODED = 8  # photographs kept in memory


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
            do: name of a step, or ``done``.
            values: its arguments; places in the scan are rays, see :meth:`~shellgs_method.picking.scan.Scan.pick`.

        Raises:
            SceneError: the step cannot be taken, or the ray hits nothing.
        """
        if do not in ("add", "move", "mark", "unmark", "remove", "leave_out", "rename", "select", "undo", "done"):
            raise SceneError(f"{do} is no step")
        with self._lock:
            if "ray" in values:
                origin, direction, reach = (np.array(part, np.float64) for part in values.pop("ray"))
                values["shell"] = self.scan.pick(origin, direction, float(reach))
                if values["shell"] is None:
                    raise SceneError("there is nothing of the scan: click on its surface")
            if do == "done":
                Thread(target=self.shutdown).start()
            else:
                getattr(self.session, do)(**values)
            return self.said()

    def image(self, number: int, side: float = 0, left: float = 0, top: float = 0, width: float = 0) -> bytes:
        """A photograph as JPEG: whole, with its longer side at most ``side`` pixels, or a 4:3 part of it."""
        image = self._photograph(number)
        if width:
            image = image.crop((int(left), int(top), int(left + width), int(top) + int(width * 3 / 4)))
        elif side:
            image = image.copy()
            image.thumbnail((side, side), Image.Resampling.BOX)
        return encoded(np.asarray(image), "JPEG")


class _Answers(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: PickServer

    def do_GET(self) -> None:
        try:
            self._get()
        except SceneError as error:
            self._answer_json({"error": str(error)}, 400)

    def _get(self) -> None:
        url = urlsplit(self.path)
        numbers = {name: float(values[0]) for name, values in parse_qs(url.query).items()}
        scan = self.server.scan
        if url.path == "/":
            self._answer(_PAGE.read_bytes(), "text/html; charset=utf-8")
        elif url.path == "/about":
            self._answer_json(self.server.about())
        elif url.path == "/said":
            self._answer_json(self.server.said())
        elif url.path == "/vertices":
            self._answer(scan.mesh.vertices.astype("<f4").tobytes() if scan.mesh else b"")
        elif url.path == "/faces":
            self._answer(scan.mesh.faces.astype("<u4").tobytes() if scan.mesh else b"")
        elif url.path == "/points":
            self._answer(scan.cloud.points.astype("<f4").tobytes() if scan.cloud else b"")
        elif url.path == "/detail" and scan.cloud:
            centre = np.array([numbers[axis] for axis in "xyz"])
            self._answer(scan.cloud.detail(centre, numbers["radius"]).astype("<f4").tobytes())
        elif url.path == "/image":
            number, _ = int(numbers.pop("number")), numbers.pop("server", None)
            content = self.server.image(number, **numbers)
            self._answer(content, "image/jpeg", "max-age=86400")
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.headers.get("Content-Type") != "application/json":  # a form of another page cannot send this
            self.send_error(415)
            return
        try:
            self._answer_json(self.server.step(**json.loads(content)))
        except SceneError as error:
            self._answer_json({"error": str(error)}, 400)
        except OSError as error:  # a full disk: the next step writes all points again
            self._answer_json({"error": explained(error)}, 400)

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
