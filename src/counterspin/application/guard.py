"""Who may ask the application, how much, and what a browser may do with the answer.

A page of this machine is within reach of every other page in the same browser, and of every user
of the same machine. So nothing is answered that was not asked from the application's own page:

- the Host is this machine's own name with the port (a foreign name that was made to lead here, DNS
  rebinding, gets 403), and so is the Origin where there is one;
- what is asked of the folder carries a cookie, which is given for the token in the link that
  `counterspin serve` prints; the token stands in the link's fragment, which no browser sends;
- what changes something says its Origin;
- no request is larger than its limit.

- `Door`: the secrets of one server, and its names
- `Guard`: refuses whatever else comes
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping
from dataclasses import field
from http.cookies import CookieError, SimpleCookie
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from counterspin.frozen import frozen

#: Where the token is given for the cookie.
SESSION: Final = "/api/session"

#: Most bytes of a request that brings a form, and of one that brings a file.
FORM_BYTES: Final = 4_000_000
FILE_BYTES: Final = 4_000_000_000

#: Where files are brought.
FILES: Final = "/api/files"

#: Methods that change nothing.
_READING_METHODS: Final = ("GET", "HEAD")

#: Names of this machine alone.
_HOST_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")

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


@frozen
class Door:
    """The secrets of one server, and the names by which it is reached.

    Attributes
    ----------
    port
        Where it listens.
    token
        In the link; whoever has it gets the cookie.
    pass_word
        In the cookie.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    pass_word: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def link(self) -> str:
        """What is opened in the browser."""
        return f"http://{_HOST_NAMES[0]}:{self.port}/#token={self.token}"

    @property
    def cookie(self) -> str:
        """The cookie's name; cookies of one machine are shared by all its ports."""
        return f"counterspin-{self.port}"

    @property
    def hosts(self) -> frozenset[str]:
        """What a request's Host may be."""
        return frozenset(f"{name}:{self.port}" for name in _HOST_NAMES)

    def opens(self, token: str) -> bool:
        """Tell whether a token is the link's."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def admits(self, headers: Headers) -> bool:
        """Tell whether a request carries the cookie."""
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        held = cookies.get(self.cookie)
        return held is not None and secrets.compare_digest(
            held.value.encode(), self.pass_word.encode()
        )


class Guard:
    """Lets through what the application's own page asks, and answers all else itself."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self._app = app
        self._door = door

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

        refusal = next(self._refusals(scope), None)
        if refusal is not None:
            status, why = refusal
            await JSONResponse({"error": why}, status)(scope, receive, send_guarded)
            return
        await self._limited(scope, receive, send_guarded)

    def _refusals(self, scope: Scope) -> Iterator[tuple[int, str]]:
        """Yield why a request is refused, with the status; the first reason counts."""
        headers, path = Headers(scope=scope), scope["path"]
        hosts = [host.lower() for host in headers.getlist("host")]
        if len(hosts) != 1 or hosts[0] not in self._door.hosts:
            yield 403, "This page is reached by its own address alone."
        origins = headers.getlist("origin")
        same_site = headers.get("sec-fetch-site", "same-origin") in ("same-origin", "none")
        if any(origin.lower() != f"http://{hosts[0]}" for origin in origins):
            yield 403, "Another page asked for this; it gets no answer."
        if scope["method"] not in _READING_METHODS and not origins:
            yield 403, "The request does not say where it comes from."
        if path.startswith("/api/"):
            if not same_site:
                yield 403, "Another page asked for this; it gets no answer."
            if path != SESSION and not self._door.admits(headers):
                yield 401, "Open the link that `counterspin serve` printed; it holds the key."
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit()) or int(length) > _most(path):
            yield 413, _too_large(path)

    async def _limited(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on; one that turns out to be too large ends there."""
        left = _most(scope["path"])
        begun = False

        async def receive_limited() -> Message:
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:
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
                why = _too_large(scope["path"])
                await JSONResponse({"error": why}, 413)(scope, receive, send)
        except Exception as error:  # no traceback for a user
            if not begun:
                why = f"internal error ({type(error).__name__}: {error})"
                await JSONResponse({"error": why}, 500)(scope, receive, send)


class _TooLargeError(Exception):
    """A request brought more than its limit."""


def _most(path: str) -> int:
    return FILE_BYTES if path == FILES else FORM_BYTES


def _too_large(path: str) -> str:
    return f"The request is too large; at most {_most(path)} bytes are taken."
