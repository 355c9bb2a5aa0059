"""`counterspin serve`: a folder as a page of this machine alone.

- `serve`: until Ctrl-C
- `application`: what answers; `server_of`, `listening`: the server and its socket
"""

from __future__ import annotations

import json
import socket
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib import import_module, resources
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import uvicorn
from h11 import LocalProtocolError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from counterspin.application import drafts
from counterspin.application.campaigns import as_json
from counterspin.application.desk import Desk
from counterspin.application.folder import ServedFolder
from counterspin.application.guard import FILES, SESSION, Door, Guard
from counterspin.application.interface import Answer, answer, answered
from counterspin.errors import CounterspinError

#: This machine, and no other.
_ADDRESS: Final = "127.0.0.1"

#: Endings of the page's own files -> what they are.
_KINDS: Final = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}


def application(desk: Desk, door: Door) -> Starlette:
    """Return what answers requests for a folder.

    Parameters
    ----------
    desk
        What is served; its jobs end with the server.
    door
        Who is let in.
    """

    async def session(request: Request) -> Response:
        try:
            said = json.loads(await request.body())
            token = said["token"]
            opened = isinstance(token, str) and door.opens(token)
        except (ValueError, KeyError, TypeError, RecursionError):
            opened = False
        if not opened:
            why = "That is not the key of this server; open the link that it printed."
            return JSONResponse({"error": why}, 403)
        response = Response(status_code=204)
        response.set_cookie(door.cookie, door.pass_word, httponly=True, samesite="strict", path="/")
        return response

    async def asked(request: Request) -> Response:
        said: Any = dict(request.query_params) if request.method == "GET" else await request.body()
        name = request.path_params["name"]
        return _response(await run_in_threadpool(answer, desk, request.method, name, said))

    async def files(request: Request) -> Response:
        name = request.query_params.get("name", "")
        begun = await run_in_threadpool(answered, desk, lambda: drafts.place_for(desk, name))
        if isinstance(begun, Answer):
            return _response(begun)
        try:
            with begun.part.open("wb") as file:
                async for piece in request.stream():
                    await run_in_threadpool(file.write, piece)
            made = await run_in_threadpool(answered, desk, lambda: drafts.arrived(desk, begun))
            return _response(made if isinstance(made, Answer) else Answer(200, made))
        except OSError as error:
            return _response(Answer(422, {"error": f"{name}: cannot be written: {error.strerror}"}))
        finally:
            begun.end()

    async def page(request: Request) -> Response:
        return _page_file(request.path_params.get("file", "index.html"))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(desk.close)

    served = Starlette(
        routes=[
            Route(SESSION, session, methods=["POST"]),
            Route(FILES, files, methods=["POST"]),
            Route("/api/{name}", asked, methods=["GET", "POST", "PUT", "DELETE"]),
            Route("/", page),
            Route("/assets/{file}", page),
        ],
        middleware=[Middleware(Guard, door=door)],
        lifespan=lifespan,
    )
    # An address with a slash too many is no other page's.
    served.router.redirect_slashes = False
    return served


def _response(made: Answer) -> Response:
    content = as_json(made.content) if made.kind == "application/json" else made.content
    headers = {}
    if made.name is not None:
        name = quote(made.name, safe="", errors="surrogateescape")
        headers["Content-Disposition"] = f"attachment; filename*=UTF-8''{name}"
    return Response(content, made.status, headers, media_type=made.kind)


def _page_file(name: str) -> Response:
    """Return a file of the page: our own, or the reports'."""
    from counterspin.reports.html import page_script, page_style

    made: dict[str, Callable[[], str]] = {"report.css": page_style, "report.js": page_script}
    kind = _KINDS.get(Path(name).suffix)
    if kind is None:
        return JSONResponse({"error": "There is no such page."}, 404)
    if name in made:
        return Response(made[name](), media_type=kind)
    assets = resources.files("counterspin.application") / "assets"
    # Found among those that there are: what is asked for is never made a path.
    file = next((one for one in assets.iterdir() if one.name == name), None)
    if file is None:
        return JSONResponse({"error": "There is no such page."}, 404)
    return Response(file.read_text(encoding="utf-8"), media_type=kind)


def serve(
    folder: Path,
    *,
    port: int = 0,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Serve a folder to this machine's browser until Ctrl-C.

    Parameters
    ----------
    folder
        Whose campaigns are shown; nothing outside of it is read or written.
    port
        Where to listen; 0: any that is free.
    browser
        Whether the page is opened.
    say
        Takes the link, and that it has ended.

    Raises
    ------
    CounterspinError
        If there is no such folder, or the port is taken.
    """
    desk = Desk(ServedFolder(folder))
    with listening(port) as listener:
        door = Door(listener.getsockname()[1])
        say(f"Serving {folder} to this machine alone. Ctrl-C ends it.")
        say(f"  {door.link}")
        if browser:
            opening = threading.Timer(0.3, webbrowser.open, [door.link])
            opening.daemon = True
            opening.start()
        threading.Thread(target=_load, args=(desk,), daemon=True).start()
        # Ctrl-C is what ends it; uvicorn has closed all by then.
        with suppress(KeyboardInterrupt):
            server_of(desk, door).run(sockets=[listener])
    say("Ended.")


def _load(desk: Desk) -> None:
    """Load, while nothing is asked yet, what the first records, words and pictures need.

    Fonts and templates are had only by drawing and writing something once.
    """
    pages = "counterspin.calibration.pages.full_report"
    for name in ("polars", "scipy.special", "counterspin.calibration.observed", pages):
        import_module(name)
    from counterspin.reports.blocks import Bars
    from counterspin.reports.charts import svg
    from counterspin.reports.html import part

    bars = Bars("Title", ("Part",), (1.0,), ("1",))
    with desk.drawing:
        svg(bars, theme="page")
    part([bars], title="Title")


class _Connection(H11Protocol):
    """A connection that is closed where what comes is no HTTP, and was answered already."""

    def data_received(self, data: bytes) -> None:
        try:
            super().data_received(data)
        except LocalProtocolError:
            self.transport.close()


def server_of(desk: Desk, door: Door) -> uvicorn.Server:
    """Return the server of a folder, which is run with a socket that listens at the door."""
    config = uvicorn.Config(
        application(desk, door),
        http=_Connection,
        # What goes wrong is answered. That a request's end was no HTTP is nothing to be told.
        log_level="critical",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def listening(port: int) -> socket.socket:
    """Return a socket that listens to this machine alone; CounterspinError if it cannot be had."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_ADDRESS, port))
        listener.listen()
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise CounterspinError(
            f"port {port} of this machine cannot be had ({reason}); give another `port`, or 0 "
            "for any that is free"
        ) from error
    return listener
