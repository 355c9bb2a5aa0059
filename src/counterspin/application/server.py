"""`counterspin serve`: a folder as a page for this machine only.

Every user of this machine can connect. Therefore connections are limited in number, and requests
without the key in time (a few seconds) and in size.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import lru_cache
from html import escape
from importlib import import_module, resources
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import h11
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from counterspin.application import keeping
from counterspin.application.campaigns import as_json
from counterspin.application.desk import Desk
from counterspin.application.folder import ServedFolder
from counterspin.application.guard import FILES, SESSION, TICKETS, Door, Guard
from counterspin.application.interface import Answer, answer, answer_of, ticket_answer
from counterspin.certificates.signers import command_signer
from counterspin.errors import CounterspinError
from counterspin.temporary_folders import temporary_folder

#: How long the head of a request may take to arrive, s.
HEAD_SECONDS: Final = 5.0

#: Most bytes of the head of a request.
_HEAD_BYTES: Final = 1 << 14

#: Most connections; a machine gives a process 256 descriptors or more.
_MOST_CONNECTIONS: Final = 128

#: Connections that the system keeps waiting, and that are accepted in one turn.
_BACKLOG: Final = 64


class Connection(H11Protocol):
    """A connection that is closed if the head of a request does not arrive in time."""

    _end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Register a connection; close the one that has waited longest if there are too many."""
        super().connection_made(transport)
        self._limit_time()
        made = [c for c in self.connections if isinstance(c, Connection)]
        timers = [c for c in made if c._end is not None and not c.transport.is_closing()]
        if len(made) > _MOST_CONNECTIONS and timers:
            min(timers, key=Connection._deadline).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Unregister a closed connection."""
        super().connection_lost(exc)
        self._stop_timer()

    def data_received(self, data: bytes) -> None:
        """Process bytes; close the connection if they follow an answer and are not HTTP."""
        try:
            super().data_received(data)
        except h11.LocalProtocolError:
            self.transport.close()
        self._limit_time()

    def _deadline(self) -> float:
        return math.inf if self._end is None else self._end.when()

    def _limit_time(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._stop_timer()
        elif self._end is None:
            self._end = self.loop.call_later(HEAD_SECONDS, self.transport.abort)

    def _stop_timer(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None


#: Prefix of the temporary folder of a server.
_PREFIX: Final = "counterspin-serve-"

#: This machine, and no other.
_ADDRESS: Final = "127.0.0.1"

#: How long what is being loaded is waited for at the end, s.
_LONGEST_LOADING: Final = 30.0

#: Endings of the page's own files -> what they are.
_KINDS: Final = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def application(desk: Desk, door: Door) -> Starlette:
    """Return the application that answers requests for a folder."""

    async def session(request: Request) -> Response:
        try:
            token = json.loads(await request.body())["token"]
            key = door.key_for(token) if isinstance(token, str) else None
        except (ValueError, KeyError, TypeError, RecursionError):
            key = None
        if key is None:
            why = (
                "That link has been used or is not of this server; open the newest in its terminal."
            )
            return JSONResponse({"error": why}, 403)
        if door.tell is not None:
            await run_in_threadpool(door.tell, door.link)
        return JSONResponse({"key": key})

    async def asked(request: Request) -> Response:
        said: Any = dict(request.query_params) if request.method == "GET" else await request.body()
        name = request.path_params["name"]
        return _response(await run_in_threadpool(answer, desk, request.method, name, said))

    async def ticket(request: Request) -> Response:
        return _response(
            await run_in_threadpool(ticket_answer, desk, request.path_params["ticket"])
        )

    async def files(request: Request) -> Response:
        name = request.query_params.get("name", "")
        begun = await run_in_threadpool(answer_of, desk, lambda: keeping.place_for(desk, name))
        if isinstance(begun, Answer):
            return _response(begun)
        try:
            with begun.part.open("wb") as file:
                async for piece in request.stream():
                    await run_in_threadpool(file.write, piece)
            made = await run_in_threadpool(
                answer_of, desk, lambda: keeping.complete_upload(desk, begun)
            )
            return _response(made if isinstance(made, Answer) else Answer(200, made))
        except OSError as error:
            return _response(Answer(422, {"error": f"{name}: cannot be written: {error.strerror}"}))
        finally:
            begun.end()

    async def page(request: Request) -> Response:
        return _page_file(request.path_params.get("file", "index.html"))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        asyncio.get_running_loop().set_exception_handler(_complain)
        yield
        await run_in_threadpool(desk.close)

    served = Starlette(
        routes=[
            Route(SESSION, session, methods=["POST"]),
            Route(FILES, files, methods=["POST"]),
            Route(f"{TICKETS}{{ticket}}", ticket),
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


def _complain(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log unforeseen errors, except a connection that the system refuses."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


def _response(made: Answer) -> Response:
    content = as_json(made.content) if made.kind == "application/json" else made.content
    headers = {}
    if made.name is not None:
        name = quote(made.name, safe="", errors="surrogateescape")
        headers["Content-Disposition"] = f"attachment; filename*=UTF-8''{name}"
    return Response(content, made.status, headers, media_type=made.kind)


@lru_cache(maxsize=100)
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
    signing: tuple[str, Path] | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Serve a folder to this machine's browser until Ctrl-C.

    port: Where to listen; 0: any free port.
    browser: Open the page.
    signing: A command that signs, and the certificate of its key, for certificates of the page.
    """
    if signing is None:
        desk = Desk(ServedFolder(folder))
    else:
        command, cert = signing
        options = {"signer": command, "cert": str(cert)}
        desk = Desk(ServedFolder(folder), command_signer(command, cert), options)
    private = _private_place()
    keeping.remove_abandoned_parts(desk.folder)
    with listening(port) as listener, temporary_folder(_PREFIX, private) as own:

        def tell(link: str) -> None:
            say("That link has been used; each works once. For another browser or window:")
            say(f"  {link}")

        door = Door(listener.getsockname()[1], tell=tell)
        say(f"Serving {folder} to this machine only. Ctrl-C stops the server.")
        say(f"  {door.link}")
        if browser:
            opening = threading.Timer(0.3, webbrowser.open, [_leading(own, door.link)])
            opening.daemon = True
            opening.start()
        ended = threading.Event()
        loading = threading.Thread(target=_load, args=(desk, ended), daemon=True)
        loading.start()
        # Having ended, uvicorn sends itself the signal again; what is left is to be removed first.
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with suppress(KeyboardInterrupt):
                server_of(desk, door).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, before)
            # Python aborts where it ends in the middle of an import of a library in C++.
            ended.set()
            loading.join(_LONGEST_LOADING)
    say("Ended.")


def _private_place() -> Path:
    """Return the folder in which a private folder is made.

    Windows ignores the rights that a file is made with, and TEMP may be a folder that all share.
    """
    private = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    return Path(private or tempfile.gettempdir())


def _leading(folder: Path, link: str) -> str:
    """Return the address of a file that leads to a link, which only its owner can read.

    The address that a browser opens is in the machine's list of processes, which all can see.
    """
    file, shown = folder / "open.html", escape(link)
    file.touch(0o600, exist_ok=False)
    file.write_text(
        '<!DOCTYPE html><meta charset="utf-8"><title>counterspin</title>'
        '<meta name="referrer" content="no-referrer">'
        f'<meta http-equiv="refresh" content="0; url={shown}"><a href="{shown}">counterspin</a>\n',
        encoding="utf-8",
    )
    return file.as_uri()


def _load(desk: Desk, ended: threading.Event) -> None:
    """Load the modules for the first records, words and pictures before any request.

    Drawing and writing once fills the caches of fonts and templates.
    """
    pages = "counterspin.calibration.pages.document"
    for name in ("polars", "scipy.special", "counterspin.calibration.observed_runs", pages):
        if ended.is_set():
            return
        import_module(name)
    from counterspin.reports.blocks import Bars
    from counterspin.reports.charts import svg
    from counterspin.reports.html import html_fragment

    bars = Bars("Title", ("Part",), (1.0,), ("1",))
    with desk.drawing:
        svg(bars, theme="page")
    html_fragment([bars], title="Title")


def server_of(desk: Desk, door: Door) -> uvicorn.Server:
    """Return the server of a folder, to be run with a listening socket."""
    config = uvicorn.Config(
        application(desk, door),
        http=Connection,
        backlog=_BACKLOG,
        h11_max_incomplete_event_size=_HEAD_BYTES,
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
    """Return a socket that listens to this machine only; CounterspinError if unavailable."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # where another process may take a port that is reused
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_ADDRESS, port))
        listener.listen()
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise CounterspinError(
            f"port {port} is in use or not permitted ({reason}); give another "
            "`port`, or 0 for any free one"
        ) from error
    return listener
