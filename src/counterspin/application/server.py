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

from counterspin.application import campaign_files
from counterspin.application.access_control import (
    FILES_PATH,
    SESSION_PATH,
    TICKET_PATH,
    AccessControl,
    Credentials,
)
from counterspin.application.app_state import AppState
from counterspin.application.campaigns import to_json
from counterspin.application.endpoints import (
    ApiResponse,
    call_or_error,
    handle_request,
    handle_ticket,
)
from counterspin.application.served_folder import ServedFolder
from counterspin.certificates.signers import command_signer
from counterspin.errors import CounterspinError
from counterspin.temporary_folders import temporary_folder

#: How long the head of a request may take to arrive, s.
HEAD_SECONDS: Final = 5.0

#: Most bytes of the head of a request.
_HEAD_BYTES: Final = 1 << 14

#: Most connections; a machine gives a process 256 descriptors or more.
_MAX_CONNECTIONS: Final = 128

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
        if len(made) > _MAX_CONNECTIONS and timers:
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
_LOADING_TIMEOUT: Final = 30.0

#: Endings of the page's own files -> what they are.
_MEDIA_TYPES: Final = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def make_application(app: AppState, credentials: Credentials) -> Starlette:
    """Return the application that answers requests for a folder."""

    async def session(request: Request) -> Response:
        try:
            token = json.loads(await request.body())["token"]
            key = credentials.exchange_token(token) if isinstance(token, str) else None
        except (ValueError, KeyError, TypeError, RecursionError):
            key = None
        if key is None:
            why = (
                "This link has already been used, or it belongs to another server. Open the "
                "most recent link shown in the terminal."
            )
            return JSONResponse({"error": why}, 403)
        if credentials.on_token_used is not None:
            await run_in_threadpool(credentials.on_token_used, credentials.link)
        return JSONResponse({"key": key})

    async def asked(request: Request) -> Response:
        payload: Any = (
            dict(request.query_params) if request.method == "GET" else await request.body()
        )
        name = request.path_params["name"]
        return _to_starlette(
            await run_in_threadpool(handle_request, app, request.method, name, payload)
        )

    async def ticket(request: Request) -> Response:
        return _to_starlette(
            await run_in_threadpool(handle_ticket, app, request.path_params["ticket"])
        )

    async def files(request: Request) -> Response:
        name = request.query_params.get("name", "")
        upload = await run_in_threadpool(
            call_or_error, app, lambda: campaign_files.open_upload(app, name)
        )
        if isinstance(upload, ApiResponse):
            return _to_starlette(upload)
        try:
            with upload.temporary_path.open("wb") as file:
                async for chunk in request.stream():
                    await run_in_threadpool(file.write, chunk)
            response = await run_in_threadpool(
                call_or_error, app, lambda: campaign_files.complete_upload(app, upload)
            )
            return _to_starlette(
                response if isinstance(response, ApiResponse) else ApiResponse(200, response)
            )
        except OSError as error:
            return _to_starlette(
                ApiResponse(
                    422,
                    {
                        "error": f"{name} cannot be written ({error.strerror})",
                        "code": "file-not-writable",
                    },
                )
            )
        finally:
            upload.discard()

    async def page(request: Request) -> Response:
        return _static_file(request.path_params.get("file", "index.html"))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        asyncio.get_running_loop().set_exception_handler(_log_unexpected)
        yield
        await run_in_threadpool(app.close)

    served = Starlette(
        routes=[
            Route(SESSION_PATH, session, methods=["POST"]),
            Route(FILES_PATH, files, methods=["POST"]),
            Route(f"{TICKET_PATH}{{ticket}}", ticket),
            Route("/api/{name}", asked, methods=["GET", "POST", "PUT", "DELETE"]),
            Route("/", page),
            Route("/assets/{file}", page),
        ],
        middleware=[Middleware(AccessControl, credentials=credentials)],
        lifespan=lifespan,
    )
    # An address with a slash too many is no other page's.
    served.router.redirect_slashes = False
    return served


def _log_unexpected(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log unforeseen errors, except a connection that the system refuses."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


def _to_starlette(response: ApiResponse) -> Response:
    content = (
        to_json(response.content) if response.media_type == "application/json" else response.content
    )
    headers = {}
    if response.file_name is not None:
        name = quote(response.file_name, safe="", errors="surrogateescape")
        headers["Content-Disposition"] = f"attachment; filename*=UTF-8''{name}"
    return Response(content, response.status, headers, media_type=response.media_type)


@lru_cache(maxsize=100)
def _static_file(name: str) -> Response:
    """Return a file of the page: our own, or the reports'."""
    from counterspin.reports.html import page_script, page_style

    generated: dict[str, Callable[[], str]] = {"report.css": page_style, "report.js": page_script}
    media_type = _MEDIA_TYPES.get(Path(name).suffix)
    if media_type is None:
        return JSONResponse({"error": "This page does not exist."}, 404)
    if name in generated:
        return Response(generated[name](), media_type=media_type)
    assets = resources.files("counterspin.application") / "assets"
    # Found among those that there are: what is asked for is never made a path.
    file = next((candidate for candidate in assets.iterdir() if candidate.name == name), None)
    if file is None:
        return JSONResponse({"error": "This page does not exist."}, 404)
    return Response(file.read_text(encoding="utf-8"), media_type=media_type)


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
        app = AppState(ServedFolder(folder))
    else:
        command, cert = signing
        options = {"signer": command, "cert": str(cert)}
        app = AppState(ServedFolder(folder), command_signer(command, cert), options)
    private = _private_folder()
    campaign_files.remove_abandoned_folders_in(app.folder)
    with open_listener(port) as listener, temporary_folder(_PREFIX, private) as link_folder:

        def print_link(link: str) -> None:
            say(
                "This link has been used. Each link works only once. Link for another browser "
                "or window:"
            )
            say(f"  {link}")

        credentials = Credentials(listener.getsockname()[1], on_token_used=print_link)
        say(f"The folder {folder} is served to this machine only. Ctrl-C stops the server.")
        say(f"  {credentials.link}")
        if browser:
            opening = threading.Timer(
                0.3, webbrowser.open, [_write_redirect(link_folder, credentials.link)]
            )
            opening.daemon = True
            opening.start()
        has_ended = threading.Event()
        loading = threading.Thread(target=_preload, args=(app, has_ended), daemon=True)
        loading.start()
        # Having ended, uvicorn sends itself the signal again; what is left is to be removed first.
        previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with suppress(KeyboardInterrupt):
                make_server(app, credentials).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, previous_handler)
            # Python aborts where it ends in the middle of an import of a library in C++.
            has_ended.set()
            loading.join(_LOADING_TIMEOUT)
    say("Server stopped.")


def _private_folder() -> Path:
    """Return the folder in which a private folder is made.

    Windows ignores the rights that a file is made with, and TEMP may be a folder that all share.
    """
    private = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    return Path(private or tempfile.gettempdir())


def _write_redirect(folder: Path, link: str) -> str:
    """Return the address of a file that leads to a link, which only its owner can read.

    The address that a browser opens is in the machine's list of processes, which all can see.
    """
    file, escaped_link = folder / "open.html", escape(link)
    file.touch(0o600, exist_ok=False)
    file.write_text(
        '<!DOCTYPE html><meta charset="utf-8"><title>counterspin</title>'
        '<meta name="referrer" content="no-referrer">'
        f'<meta http-equiv="refresh" content="0; url={escaped_link}">'
        f'<a href="{escaped_link}">counterspin</a>\n',
        encoding="utf-8",
    )
    return file.as_uri()


def _preload(app: AppState, has_ended: threading.Event) -> None:
    """Load the modules for the first records, words and pictures before any request.

    Drawing and writing once fills the caches of fonts and templates.
    """
    pages = "counterspin.calibration.pages.document"
    for name in ("polars", "scipy.special", "counterspin.calibration.observed_runs", pages):
        if has_ended.is_set():
            return
        import_module(name)
    from counterspin.reports.blocks import Bars
    from counterspin.reports.charts import render_svg
    from counterspin.reports.html import render_fragment

    bars = Bars("Title", ("Part",), (1.0,), ("1",))
    with app.drawing:
        render_svg(bars, theme="page")
    render_fragment([bars], title="Title")


def make_server(app: AppState, credentials: Credentials) -> uvicorn.Server:
    """Return the server of a folder, to be run with a listening socket."""
    config = uvicorn.Config(
        make_application(app, credentials),
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


def open_listener(port: int) -> socket.socket:
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
            "`port`, or 0 for any free port",
            code="port-in-use",
        ) from error
    return listener
