"""Access control of the application, limits of requests, and the browser's permissions.

Every page in the same browser, and every user of the same machine, can reach the server. Therefore
only requests of the application's own page are accepted:

- The Host must be a name of this machine with the port (against DNS rebinding), and so must the
  Origin, if present.
- Requests for data carry the key in a header, which no browser adds by itself (cookies ignore
  ports, so every server on this machine would get them). The page exchanges the token in the link
  that `counterspin serve` prints for the key. The token is valid once, and is in the fragment of
  the link, which browsers do not send.
- Files that the browser downloads by itself have addresses that are valid once.
- Requests that change data must have an Origin.
- The size of requests is limited. Without the key, the limit is small, and time is limited too.
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

#: Path for exchanging the token for the key.
SESSION_PATH: Final = "/api/session"

#: Prefix of paths with tickets.
TICKET_PATH: Final = "/api/ticket/"

#: Lifetime of a ticket, s, and largest number of tickets.
_TICKET_LIFETIME: Final = 60.0
_MAX_TICKETS: Final = 100

#: Largest size of a request without the key, of a form, and of an uploaded file, in bytes.
UNAUTHENTICATED_MAX_BYTES: Final = 4000
FORM_MAX_BYTES: Final = 4_000_000
FILE_MAX_BYTES: Final = 4_000_000_000

#: Timeout for receiving a request without the key, s.
UNAUTHENTICATED_TIMEOUT: Final = 5.0

#: Size above which forms are large, in bytes; only a few large forms are read at a time.
_MIN_LARGE_FORM_BYTES: Final = 1 << 16
_MAX_LARGE_FORMS: Final = 2

#: Path for uploads.
FILES_PATH: Final = "/api/files"

#: HTTP methods that do not change data.
_SAFE_METHODS: Final = ("GET", "HEAD")

#: Names of the loopback interface.
_LOCAL_HOST_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")

#: Response to requests for data without the key.
MISSING_KEY_MESSAGE: Final = (
    "This window does not have the server's key. Open the most recent link that is shown "
    "in the terminal of `counterspin serve`. Each link works only once."
)

#: Content security policy: the page's own modules, styles and data; SVG has style attributes.
_CONTENT_SECURITY_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)

_SECURITY_HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": _CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Credentials:
    """The secrets of a server, and its host names."""

    def __init__(
        self,
        port: int,
        token: str | None = None,
        key: str | None = None,
        on_token_used: Callable[[str], None] | None = None,
    ) -> None:
        self.port = port
        self.on_token_used = on_token_used
        self._token = token or secrets.token_urlsafe(24)
        self._key = key or secrets.token_urlsafe(24)

    @property
    def link(self) -> str:
        """The link that opens the page, once."""
        return f"http://{_LOCAL_HOST_NAMES[0]}:{self.port}/#token={self._token}"

    @property
    def hosts(self) -> frozenset[str]:
        """Valid values of the Host header."""
        return frozenset(f"{name}:{self.port}" for name in _LOCAL_HOST_NAMES)

    def exchange_token(self, token: str) -> str | None:
        """Return the key in exchange for the token, and issue a new token; None if it is wrong."""
        if not secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode()):
            return None
        self._token = secrets.token_urlsafe(24)
        return self._key

    def is_authorized(self, headers: Headers) -> bool:
        """Return whether a request carries the key."""
        authorizations = headers.getlist("authorization")
        expected_authorization = f"Bearer {self._key}"
        return len(authorizations) == 1 and secrets.compare_digest(
            authorizations[0].encode(), expected_authorization.encode()
        )


class Tickets(Generic[T]):
    """Tickets for single requests, valid once and for a short time."""

    def __init__(self) -> None:
        self._targets: dict[str, tuple[float, T]] = {}
        self._lock = threading.Lock()

    def issue(self, target: T) -> str:
        """Return a ticket for a request; if there are too many, the oldest is removed."""
        ticket = secrets.token_urlsafe(24)
        with self._lock:
            self._targets[ticket] = (time.monotonic(), target)
            while len(self._targets) > _MAX_TICKETS:
                del self._targets[next(iter(self._targets))]
        return ticket

    def redeem(self, ticket: str) -> T | None:
        """Return the request of a ticket; None if the ticket is not valid."""
        with self._lock:
            issue_time, target = self._targets.pop(ticket, (-_TICKET_LIFETIME, None))
        return target if time.monotonic() - issue_time < _TICKET_LIFETIME else None


class AccessControl:
    """ASGI middleware that accepts only requests of the application's own page."""

    def __init__(self, app: ASGIApp, credentials: Credentials) -> None:
        self._app = app
        self._credentials = credentials
        self._large_forms = asyncio.Semaphore(_MAX_LARGE_FORMS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on or refuse a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _SECURITY_HEADERS.items():
                    headers[name] = value
            await send(message)

        is_authorized = self._credentials.is_authorized(Headers(scope=scope))
        max_bytes = _max_bytes(scope["path"]) if is_authorized else UNAUTHENTICATED_MAX_BYTES
        first_refusal = next(
            self._refusals(scope, is_authorized=is_authorized, max_bytes=max_bytes), None
        )
        if first_refusal is not None:
            status, reason = first_refusal
            # Without the key, the body of the request is not read.
            headers = None if is_authorized else {"Connection": "close"}
            await JSONResponse({"error": reason}, status, headers)(
                scope, receive, send_with_headers
            )
            return
        timeout = math.inf if is_authorized else UNAUTHENTICATED_TIMEOUT
        await self._call_limited(scope, receive, send_with_headers, max_bytes, timeout)

    def _refusals(
        self, scope: Scope, *, is_authorized: bool, max_bytes: int
    ) -> Iterator[tuple[int, str]]:
        """Yield the reasons to refuse a request, with the status."""
        headers, path = Headers(scope=scope), scope["path"]
        hosts = [host.lower() for host in headers.getlist("host")]
        if len(hosts) != 1 or hosts[0] not in self._credentials.hosts:
            yield 403, "Open the application at the address that `counterspin serve` printed."
        origins = headers.getlist("origin")
        is_same_site = headers.get("sec-fetch-site", "same-origin") in ("same-origin", "none")
        if any(origin.lower() != f"http://{hosts[0]}" for origin in origins):
            yield 403, "The request was refused because it came from another web page."
        if scope["method"] not in _SAFE_METHODS and not origins:
            yield 403, "The request has no Origin header."
        if path.startswith("/api/"):
            if not is_same_site:
                yield 403, "The request was refused because it came from another web page."
            if not (is_authorized or path == SESSION_PATH or path.startswith(TICKET_PATH)):
                yield 401, MISSING_KEY_MESSAGE
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit()) or int(length) > max_bytes:
            yield 413, _too_large_message(max_bytes)

    async def _call_limited(
        self, scope: Scope, receive: Receive, send: Send, max_bytes: int, timeout: float
    ) -> None:
        """Pass a request on; abort it if its body exceeds the limit of size or time."""
        n_bytes_received = 0
        has_response_begun = holds_slot = is_complete = False
        deadline = asyncio.get_running_loop().time() + timeout

        async def receive_limited() -> Message:
            nonlocal n_bytes_received, holds_slot, is_complete
            if (
                n_bytes_received > _MIN_LARGE_FORM_BYTES
                and max_bytes <= FORM_MAX_BYTES
                and not holds_slot
            ):
                # Many large forms at once would use too much memory.
                holds_slot = await self._large_forms.acquire()
            try:
                async with asyncio.timeout_at(None if is_complete else deadline):
                    message = await receive()
            except TimeoutError as error:
                raise _RequestTimeoutError from error
            is_complete = not message.get("more_body", False)
            n_bytes_received += len(message.get("body", b""))
            if n_bytes_received > max_bytes:
                raise _RequestTooLargeError
            return message

        async def send_and_record(message: Message) -> None:
            nonlocal has_response_begun
            has_response_begun = True
            await send(message)

        try:
            await self._app(scope, receive_limited, send_and_record)
        except ClientDisconnect:
            return  # the client has disconnected
        except _RequestTooLargeError:
            if not has_response_begun:
                reason = _too_large_message(max_bytes)
                await JSONResponse({"error": reason}, 413)(scope, receive, send)
        except _RequestTimeoutError:
            if not has_response_begun:
                reason = f"The complete request was not received within {timeout:g} s."
                response = JSONResponse({"error": reason}, 408, {"Connection": "close"})
                await response(scope, receive, send)
        except Exception as error:  # no traceback for a user
            if not has_response_begun:
                reason = f"internal error ({type(error).__name__}: {error})"
                await JSONResponse({"error": reason}, 500)(scope, receive, send)
        finally:
            if holds_slot:
                self._large_forms.release()


class _RequestTooLargeError(Exception):
    """The error for a request whose body exceeds its limit."""


class _RequestTimeoutError(Exception):
    """The error for a request whose body does not arrive in time."""


def _max_bytes(path: str) -> int:
    return FILE_MAX_BYTES if path == FILES_PATH else FORM_MAX_BYTES


def _too_large_message(max_bytes: int) -> str:
    return f"The request is too large; at most {max_bytes} bytes are accepted."
