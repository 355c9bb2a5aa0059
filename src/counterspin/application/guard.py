"""Access control of the application, limits of requests, and the browser's permissions.

Every other page in the same browser, and every user of the same machine, can reach the server.
Therefore only requests of the application's own page are answered:

- the Host is this machine's name with the port (a foreign name that was made to lead here, DNS
  rebinding, gets 403), and so is the Origin if there is one;
- requests about the folder carry the key in a header, which no browser adds by itself (cookies
  ignore ports: every other server of this machine gets them). The page receives the key for the
  token in the link that `counterspin serve` prints; the token is valid once, and is in the link's
  fragment, which no browser sends;
- a file that a browser fetches by itself, to save it, has an address that is valid once;
- requests that change something state their Origin;
- no request exceeds its limit of size; without the key the limit is small, and time is limited too.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final, Generic, TypeVar

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

T = TypeVar("T")

#: Where the token is given for the key.
SESSION: Final = "/api/session"

#: Where tickets are taken.
TICKETS: Final = "/api/ticket/"

#: How long a ticket counts, s, and how many there are.
_TICKET_SECONDS: Final = 60.0
_MOST_TICKETS: Final = 100

#: Most bytes of a request without the key, of one that brings a form, and of one with a file.
STRANGER_BYTES: Final = 4000
FORM_BYTES: Final = 4_000_000
FILE_BYTES: Final = 4_000_000_000

#: How long a request without the key may take to arrive, s.
STRANGER_SECONDS: Final = 5.0

#: Larger forms are read a few at a time, the others wait.
_LARGE_BYTES: Final = 1 << 16
_LARGE_FORMS: Final = 2

#: Where files are brought.
FILES: Final = "/api/files"

#: Methods that change nothing.
_READING_METHODS: Final = ("GET", "HEAD")

#: Names of this machine alone.
_HOST_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")

#: What is told to who asks for something of the folder without the key.
NO_KEY: Final = (
    "This window does not have the server's key. Open the newest link in the terminal in "
    "which `counterspin serve` runs; each link works once."
)

#: What the page may load: its own modules, styles and data; pictures have styles of their own.
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)

_HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Door:
    """The secrets of one server, and its host names."""

    def __init__(
        self,
        port: int,
        token: str | None = None,
        key: str | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self.port = port
        self.tell = tell
        self._token = token or secrets.token_urlsafe(24)
        self._key = key or secrets.token_urlsafe(24)

    @property
    def link(self) -> str:
        """The link that opens the page, once."""
        return f"http://{_HOST_NAMES[0]}:{self.port}/#token={self._token}"

    @property
    def hosts(self) -> frozenset[str]:
        """The valid values of a request's Host."""
        return frozenset(f"{name}:{self.port}" for name in _HOST_NAMES)

    def key_for(self, token: str) -> str | None:
        """Exchange the link's token for the key and issue a new token; None for any other token."""
        if not secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode()):
            return None
        self._token = secrets.token_urlsafe(24)
        return self._key

    def admits(self, headers: Headers) -> bool:
        """Return whether a request carries the key."""
        said = headers.getlist("authorization")
        known = f"Bearer {self._key}"
        return len(said) == 1 and secrets.compare_digest(said[0].encode(), known.encode())


class Tickets(Generic[T]):
    """Addresses that are valid once and for a short time, each for one request."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[float, T]] = {}
        self._lock = threading.Lock()

    def issue(self, target: T) -> str:
        """Return a ticket for a request; the oldest expires if there are too many."""
        ticket = secrets.token_urlsafe(24)
        with self._lock:
            self._held[ticket] = (time.monotonic(), target)
            while len(self._held) > _MOST_TICKETS:
                del self._held[next(iter(self._held))]
        return ticket

    def take(self, ticket: str) -> T | None:
        """Return the request of a ticket; None if it is not valid."""
        with self._lock:
            issued, target = self._held.pop(ticket, (-_TICKET_SECONDS, None))
        return target if time.monotonic() - issued < _TICKET_SECONDS else None


class Guard:
    """Passes on the requests of the application's own page, and refuses all others."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self._app = app
        self._door = door
        self._large_forms = asyncio.Semaphore(_LARGE_FORMS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
            await send(message)

        known = self._door.admits(Headers(scope=scope))
        most = _most(scope["path"]) if known else STRANGER_BYTES
        refusal = next(self._refusals(scope, known=known, most=most), None)
        if refusal is not None:
            status, why = refusal
            # Nothing more is read of who shows no key.
            headers = None if known else {"Connection": "close"}
            await JSONResponse({"error": why}, status, headers)(scope, receive, send_guarded)
            return
        seconds = math.inf if known else STRANGER_SECONDS
        await self._limited(scope, receive, send_guarded, most, seconds)

    def _refusals(self, scope: Scope, *, known: bool, most: int) -> Iterator[tuple[int, str]]:
        """Yield the reasons to refuse a request, with the status; the first one is used."""
        headers, path = Headers(scope=scope), scope["path"]
        hosts = [host.lower() for host in headers.getlist("host")]
        if len(hosts) != 1 or hosts[0] not in self._door.hosts:
            yield 403, "This page can only be reached by its own address."
        origins = headers.getlist("origin")
        same_site = headers.get("sec-fetch-site", "same-origin") in ("same-origin", "none")
        if any(origin.lower() != f"http://{hosts[0]}" for origin in origins):
            yield 403, "Another page sent this request, which is refused."
        if scope["method"] not in _READING_METHODS and not origins:
            yield 403, "The request does not state its origin."
        if path.startswith("/api/"):
            if not same_site:
                yield 403, "Another page sent this request, which is refused."
            if not (known or path == SESSION or path.startswith(TICKETS)):
                yield 401, NO_KEY
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit()) or int(length) > most:
            yield 413, _too_large(most)

    async def _limited(
        self, scope: Scope, receive: Receive, send: Send, most: int, seconds: float
    ) -> None:
        """Pass a request on; stop it if its body exceeds the limit of size or of time."""
        taken = 0
        begun = waited = complete = False
        deadline = asyncio.get_running_loop().time() + seconds

        async def receive_limited() -> Message:
            nonlocal taken, waited, complete
            if taken > _LARGE_BYTES and most <= FORM_BYTES and not waited:
                # Many of them at once would hold much memory.
                waited = await self._large_forms.acquire()
            try:
                async with asyncio.timeout_at(None if complete else deadline):
                    message = await receive()
            except TimeoutError as error:
                raise _TooLateError from error
            complete = not message.get("more_body", False)
            taken += len(message.get("body", b""))
            if taken > most:
                raise _TooLargeError
            return message

        async def send_noted(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive_limited, send_noted)
        except ClientDisconnect:
            return  # who asked has gone; nobody waits for an answer
        except _TooLargeError:
            if not begun:
                why = _too_large(most)
                await JSONResponse({"error": why}, 413)(scope, receive, send)
        except _TooLateError:
            if not begun:
                why = f"The request did not arrive within {seconds:g} s."
                answer = JSONResponse({"error": why}, 408, {"Connection": "close"})
                await answer(scope, receive, send)
        except Exception as error:  # no traceback for a user
            if not begun:
                why = f"internal error ({type(error).__name__}: {error})"
                await JSONResponse({"error": why}, 500)(scope, receive, send)
        finally:
            if waited:
                self._large_forms.release()


class _TooLargeError(Exception):
    """The error for a request whose body exceeds its limit."""


class _TooLateError(Exception):
    """The error for a request whose body does not arrive in time."""


def _most(path: str) -> int:
    return FILE_BYTES if path == FILES else FORM_BYTES


def _too_large(most: int) -> str:
    return f"The request is too large; at most {most} bytes are taken."
