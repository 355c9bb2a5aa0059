"""`counterspin serve`: web server of the application, reachable from this machine only.

Every user of this machine can connect. Therefore the number of connections is limited, and time and
size of requests without the key.
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
    call_with_error_response,
    handle_request,
    handle_ticket,
)
from counterspin.application.served_folder import ServedFolder
from counterspin.certificates.signers import command_signer
from counterspin.errors import CounterspinError
from counterspin.temporary_folders import temporary_folder

#: Timeout for receiving the head of a request, s.
HEAD_TIMEOUT: Final = 5.0

#: Largest size of the head of a request, in bytes.
_MAX_HEAD_BYTES: Final = 1 << 14

#: Largest number of connections; a process has at least 256 file descriptors.
_MAX_CONNECTIONS: Final = 128

#: Length of the queue of pending connections.
_LISTEN_BACKLOG: Final = 64


class TimedConnection(H11Protocol):
    """A connection that is closed if the head of a request is not received in time."""

    _head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Register a connection; if there are too many, close the one that has waited longest."""
        super().connection_made(transport)
        self._update_timer()
        connections = [c for c in self.connections if isinstance(c, TimedConnection)]
        waiting_connections = [
            c for c in connections if c._head_timer is not None and not c.transport.is_closing()
        ]
        if len(connections) > _MAX_CONNECTIONS and waiting_connections:
            min(waiting_connections, key=TimedConnection._deadline).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Unregister a closed connection."""
        super().connection_lost(exc)
        self._stop_timer()

    def data_received(self, data: bytes) -> None:
        """Process received data; close the connection on a protocol error."""
        try:
            super().data_received(data)
        except h11.LocalProtocolError:
            self.transport.close()
        self._update_timer()

    def _deadline(self) -> float:
        return math.inf if self._head_timer is None else self._head_timer.when()

    def _update_timer(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._stop_timer()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(HEAD_TIMEOUT, self.transport.abort)

    def _stop_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None


#: Prefix of the temporary folder of a server.
_FOLDER_PREFIX: Final = "counterspin-serve-"

#: Loopback address.
_LOOPBACK_ADDRESS: Final = "127.0.0.1"

#: Timeout for the end of preloading, s.
_LOADING_TIMEOUT: Final = 30.0

#: Suffix of the page's files -> media type.
_MEDIA_TYPES: Final = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def make_application(app: AppState, credentials: Credentials) -> Starlette:
    """Return the ASGI application for a folder."""

    async def create_session(request: Request) -> Response:
        try:
            token = json.loads(await request.body())["token"]
            key = credentials.exchange_token(token) if isinstance(token, str) else None
        except (ValueError, KeyError, TypeError, RecursionError):
            key = None
        if key is None:
            reason = (
                "This link has already been used, or it belongs to another server. Open the "
                "most recent link shown in the terminal."
            )
            return JSONResponse({"error": reason}, 403)
        if credentials.on_token_used is not None:
            await run_in_threadpool(credentials.on_token_used, credentials.link)
        return JSONResponse({"key": key})

    async def api_request(request: Request) -> Response:
        payload: Any = (
            dict(request.query_params) if request.method == "GET" else await request.body()
        )
        name = request.path_params["name"]
        return _to_starlette(
            await run_in_threadpool(handle_request, app, request.method, name, payload)
        )

    async def redeem_ticket(request: Request) -> Response:
        return _to_starlette(
            await run_in_threadpool(handle_ticket, app, request.path_params["ticket"])
        )

    async def receive_upload(request: Request) -> Response:
        name = request.query_params.get("name", "")
        upload = await run_in_threadpool(
            call_with_error_response, app, lambda: campaign_files.open_upload(app, name)
        )
        if isinstance(upload, ApiResponse):
            return _to_starlette(upload)
        try:
            with upload.temporary_path.open("wb") as file:
                async for chunk in request.stream():
                    await run_in_threadpool(file.write, chunk)
            response = await run_in_threadpool(
                call_with_error_response, app, lambda: campaign_files.complete_upload(app, upload)
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

    async def serve_static_file(request: Request) -> Response:
        return _static_file(request.path_params.get("file", "index.html"))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        asyncio.get_running_loop().set_exception_handler(_log_unexpected_error)
        yield
        await run_in_threadpool(app.close)

    application = Starlette(
        routes=[
            Route(SESSION_PATH, create_session, methods=["POST"]),
            Route(FILES_PATH, receive_upload, methods=["POST"]),
            Route(f"{TICKET_PATH}{{ticket}}", redeem_ticket),
            Route("/api/{name}", api_request, methods=["GET", "POST", "PUT", "DELETE"]),
            Route("/", serve_static_file),
            Route("/assets/{file}", serve_static_file),
        ],
        middleware=[Middleware(AccessControl, credentials=credentials)],
        lifespan=lifespan,
    )
    # Do not redirect addresses with an additional slash.
    application.router.redirect_slashes = False
    return application


def _log_unexpected_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log unexpected errors, except those of the operating system."""
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
    """Return a static file of the page, or a style or script of the reports."""
    from counterspin.reports.html import page_script, page_style

    generators: dict[str, Callable[[], str]] = {"report.css": page_style, "report.js": page_script}
    media_type = _MEDIA_TYPES.get(Path(name).suffix)
    if media_type is None:
        return JSONResponse({"error": "This page does not exist."}, 404)
    if name in generators:
        return Response(generators[name](), media_type=media_type)
    assets = resources.files("counterspin.application") / "assets"
    # The name is compared with existing files and never used as a path.
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
    print_line: Callable[[str], None] = print,
) -> None:
    """Serve a folder to browsers on this machine until Ctrl-C.

    port: Port to listen on; 0: any free port.
    browser: Whether to open the page.
    signing: Signing command for certificates, and certificate of its key.
    """
    if signing is None:
        app = AppState(ServedFolder(folder))
    else:
        signing_command, certificate_path = signing
        options = {"signer": signing_command, "cert": str(certificate_path)}
        app = AppState(
            ServedFolder(folder), command_signer(signing_command, certificate_path), options
        )
    private_parent = _private_folder()
    campaign_files.remove_remnants(app.folder)
    with (
        open_listener(port) as listener,
        temporary_folder(_FOLDER_PREFIX, private_parent) as link_folder,
    ):

        def print_link(link: str) -> None:
            print_line(
                "This link has now been used. Each link works only once. Link for another browser "
                "or window:"
            )
            print_line(f"  {link}")

        credentials = Credentials(listener.getsockname()[1], on_token_used=print_link)
        print_line(f"The folder {folder} is served to this machine only. Ctrl-C stops the server.")
        print_line(f"  {credentials.link}")
        if browser:
            browser_timer = threading.Timer(
                0.3, webbrowser.open, [_write_redirect(link_folder, credentials.link)]
            )
            browser_timer.daemon = True
            browser_timer.start()
        end_event = threading.Event()
        thread = threading.Thread(target=_preload_modules, args=(app, end_event), daemon=True)
        thread.start()
        # uvicorn raises the signal again at its end, but temporary files must be removed first.
        previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with suppress(KeyboardInterrupt):
                make_server(app, credentials).run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, previous_handler)
            # Python aborts if it ends during the import of a C++ library.
            end_event.set()
            thread.join(_LOADING_TIMEOUT)
    print_line("Server stopped.")


def _private_folder() -> Path:
    """Return the parent folder for a private folder.

    Windows ignores file permissions, and TEMP may be shared by all users.
    """
    local_folder = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    return Path(local_folder or tempfile.gettempdir())


def _write_redirect(folder: Path, link: str) -> str:
    """Write a file that redirects to a link, readable by its owner only; return its address.

    The address that a browser opens is visible in the list of processes; the link must not be.
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


def _preload_modules(app: AppState, end_event: threading.Event) -> None:
    """Load modules before the first request.

    Drawing a picture and rendering a page fills the caches of fonts and templates.
    """
    pages = "counterspin.calibration.pages.document"
    for name in ("polars", "scipy.special", "counterspin.calibration.observed_runs", pages):
        if end_event.is_set():
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
    """Return the server of a folder, for a listening socket."""
    config = uvicorn.Config(
        make_application(app, credentials),
        http=TimedConnection,
        backlog=_LISTEN_BACKLOG,
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
        # Errors are returned in responses; protocol errors are not logged.
        log_level="critical",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def open_listener(port: int) -> socket.socket:
    """Return a socket that listens on the loopback interface; CounterspinError if unavailable."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # SO_REUSEADDR would let another process take the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_LOOPBACK_ADDRESS, port))
        listener.listen()
    except (OSError, OverflowError) as error:
        listener.close()
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise CounterspinError(
            f"port {port} is in use or not permitted ({reason}); give another "
            "`port`, or 0 for any free port",
            code="port-in-use",
        ) from error
    return listener
