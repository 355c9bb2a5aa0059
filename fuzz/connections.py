"""Connections to the application's server, as no browser would hold them.

A case is some connections at once, as JSON: the bytes of each in pieces, which come in a stated
order. Lengths and chunks are not what the head says, requests end in the middle, or another begins
there; then the connection is closed, at either end. The server's own protocol reads them in this
process, without a socket. Every answer is whole, who leaves in the middle leaves nothing, of edits
of the same version one is taken, and the next who asks is answered.

- `connections`: the format
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from pathlib import Path
from random import Random
from typing import Any

from uvicorn.server import ServerState

from counterspin.application.served_folder import ServedFolder
from counterspin.application.server import TimedConnection, make_server
from fuzz.asking import (
    HOST,
    PORT,
    SECRET,
    InlineAppState,
    RequestRefusedError,
    Watched,
    asking,
    fixed_credentials,
)
from fuzz.format import Format
from fuzz.mutations import mutate_bytes
from fuzz.requests import prepared, request_of, valid_requests, with_ticket

#: What takes no more than some ms, and begins no process.
_ASKED = (
    "files",
    "GET folder",
    "GET campaign",
    "GET jobs",
    "PUT text",
    "POST c",
    "GET record",
    "page",
    "POST ticket",
    "session",
    "ticket",
)

#: What others send of a request, and no more.
_HALVES = ("", "G", "GET / HTTP/1.1\r\nHost: ", f"POST /api/session HTTP/1.1\r\nHost: {HOST}\r\n")

#: So often the loop turns before a request hangs.
_TURNS = 400


def _bytes(request: dict[str, Any]) -> tuple[bytes, bytes]:
    """Return a request's head and body as they are sent."""
    lines = [f"{request['method']} {request['target']} HTTP/1.1"]
    lines += [f"{name}: {value}" for name, value in request["headers"]]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1"), request["body"].encode("latin-1")


def _sent(rng: Random, request: dict[str, Any]) -> bytes:
    """Return what is sent for a request, right or wrong."""
    head, body = _bytes(request)
    kind = rng.randrange(9)
    length = re.compile(rb"content-length: \d+")
    if kind == 0:
        wrong = rng.choice((len(body) + 5, max(len(body) - 5, 0), 0, 10**7, 10**19, -1))
        head = length.sub(b"content-length: %d" % wrong, head)
    elif kind == 1:
        head = length.sub(b"transfer-encoding: chunked", head)
        parts = [body[i : i + 90] for i in range(0, len(body), 90)]
        body = b"".join(b"%x\r\n%s\r\n" % (len(part), part) for part in parts) + b"0\r\n\r\n"
        if rng.random() < 0.5:
            body = mutate_bytes(rng, body)
    elif kind == 2:
        head = mutate_bytes(rng, head)
    elif kind == 3:
        body += rng.choice((b"\r\n", b"x" * 70000, head + body, b"\0", b"GET / HTTP/1.1\r\n\r\n"))
    elif kind == 4:
        body = body[: rng.randrange(len(body) + 1)]
    elif kind == 5:
        head = head[: rng.randrange(len(head))]
        body = b""
    elif kind == 6:
        more = rng.choice(
            (
                b"expect: 100-continue",
                b"connection: close",
                b"upgrade: websocket\r\nconnection: upgrade",
                b"connection: upgrade, http2-settings\r\nupgrade: h2c",
                b"x: " + b"y" * 70000,
                b"transfer-encoding: chunked",
                b"content-length: 3",
                b" folded",
            )
        )
        head = head[:-2] + more + b"\r\n\r\n"
    return head + body


def case(rng: Random, valid: dict[str, tuple[str, str, Any]]) -> bytes:
    """Return some connections at once, as JSON."""
    names = [name for name in valid if name.startswith(_ASKED)]
    # Of edits of one file, made at once by several, all but one are refused.
    same = rng.choice(names) if rng.random() < 0.3 else None
    made = []
    for number in range(rng.choice((1, 1, 2, 5))):
        content = b""
        for _ in range(rng.choice((1, 1, 2, 3))):
            content += _sent(rng, request_of(*valid[same or rng.choice(names)]))
        pieces = rng.choice((1, 2, 5))
        cuts = sorted(rng.randrange(len(content) + 1) for _ in range(pieces - 1))
        parts = [content[a:b] for a, b in zip([0, *cuts], [*cuts, len(content)], strict=True)]
        made += [(rng.random(), number, part.decode("latin-1")) for part in parts]
    # The pieces of each in their order, those of all mixed.
    times = sorted(time for time, _, _ in made)
    steps: list[list[Any]] = []
    for number in {number for _, number, _ in made}:
        own = [part for _, one, part in made if one == number]
        at = sorted(rng.sample(times, len(own)))
        steps += [[time, number, part] for time, part in zip(at, own, strict=True)]
    steps.sort(key=lambda step: (step[0], step[1]))
    ends = {str(n): rng.choice(("wait", "leave", "leave at once")) for n in {s[1] for s in steps}}
    crowd = [rng.choice(_HALVES)] * rng.choice((0, 0, 3, 137))
    asked = {"pieces": [step[1:] for step in steps], "ends": ends, "crowd": crowd}
    return json.dumps(asked).encode()


class _Wire(asyncio.Transport):
    """The server's end of a connection, which keeps what is written."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 50000), "sockname": ("127.0.0.1", PORT)})
        self.written = b""
        self.closed = False

    def write(self, data: Any) -> None:
        self.written += bytes(data)

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = True

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None:
        """Nothing has to be held back."""

    def resume_reading(self) -> None:
        """Nothing was held back."""


class _Complaints(logging.Handler):
    """What the server would have told the terminal."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            self.told.append(logging.Formatter().format(record))


class _Server:
    """The server's protocol over a folder."""

    def __init__(self, app_state: InlineAppState, app: Any) -> None:
        self.config = make_server(app_state, fixed_credentials()).config
        self.config.load()
        self.config.loaded_app = app
        self.state = ServerState()

    def connect(self) -> TimedConnection:
        """Return the server's side of a new connection."""
        make: Any = self.config.http_protocol_class
        loop = asyncio.get_running_loop()
        made: TimedConnection = make(
            config=self.config, server_state=self.state, app_state={}, _loop=loop
        )
        made.connection_made(_Wire())
        return made

    async def settle(self) -> None:
        """Turn the loop until nothing is worked on, or all that is left waits for more."""
        for _ in range(_TURNS):
            await asyncio.sleep(0)
            if not self.state.tasks:
                return


async def _hold(app_state: InlineAppState, watched: Watched, asked: dict[str, Any]) -> list[bytes]:
    """Hold the connections of a case; return what was answered on each."""
    raised: list[str] = []
    with asking(app_state, raised) as app, watched.looking():
        server = _Server(app_state, app)
        held: dict[int, TimedConnection] = {}
        left: set[int] = set()
        for number, part in asked["pieces"]:
            if number not in held:
                held[number] = server.connect()
            # Nothing at all would be its end.
            if part and number not in left and not held[number].transport.is_closing():
                held[number].data_received(with_ticket(app_state, part).encode("latin-1"))
            await asyncio.sleep(0)
            if asked["ends"][str(number)] == "leave at once" and number % 2:
                held[number].connection_lost(None)
                left.add(number)
        for number, end in asked["ends"].items():
            if end == "wait":
                continue
            held[int(number)].eof_received()
            held[int(number)].connection_lost(None)
        await server.settle()
        before = watched.state()
        crowd = [server.connect() for _ in asked["crowd"]]
        for one, half in zip(crowd, asked["crowd"], strict=True):
            if half:
                one.data_received(half.encode("latin-1"))
        last = server.connect()
        last.data_received(_bytes(request_of("GET", "/api/jobs", {}))[0])
        await asyncio.sleep(0)
        for _ in range(_TURNS):
            await asyncio.sleep(0)
            if b"\r\n\r\n" in last.transport.written:
                break
        assert last.transport.written.startswith(b"HTTP/1.1 200"), "the next is not answered"
        for one in (*held.values(), *crowd, last):
            one.connection_lost(None)
            one._unset_keepalive_if_required()
        await server.settle()
        assert not server.state.tasks, "a request hangs although nobody is there"
        after = watched.state()
    assert not raised, raised[0]
    # Who waited for more than ever came has left nothing of it.
    gone = {name for name in before if name not in after}
    new = {name for name in after if name not in watched.first}
    hidden = {name for name in new if Path(name).name.startswith(".")}
    assert not hidden, f"left: {sorted(hidden)}"
    assert all(Path(name).name.startswith(".") or name == "new" for name in gone), gone
    lost = {name for name in watched.first if name not in after}
    assert not lost, f"lost: {sorted(lost)}"
    return [one.transport.written for one in held.values()]


def connections(place: Path) -> Format:
    """Return connections to the application."""
    template, watched = prepared(place)
    valid = valid_requests(template)
    app_state = InlineAppState(ServedFolder(watched.folder))

    def use(path: Path) -> None:
        asked = json.loads(path.read_bytes())
        complaints = _Complaints()
        for name in ("uvicorn.error", "asyncio"):
            logging.getLogger(name).addHandler(complaints)
        try:
            answered = asyncio.run(_hold(app_state, watched, asked))
        finally:
            for name in ("uvicorn.error", "asyncio"):
                logging.getLogger(name).removeHandler(complaints)
            watched.restore()
        assert not complaints.told, complaints.told[0]
        _require_right(asked, b"".join(answered))

    return Format(".json", lambda rng: case(rng, valid), use)


def _require_right(asked: dict[str, Any], answered: bytes) -> None:
    statuses = re.findall(rb"HTTP/1\.1 (\d\d\d)", answered)
    assert not any(status >= b"500" for status in statuses), statuses
    assert SECRET.encode() not in answered
    sent = "".join(part for _, part in asked["pieces"])
    if sent.count("PUT /api/text") > 1 and '"version": ""' not in sent:
        taken = len(re.findall(rb'"file":"(three/campaign|LAB)\.toml","version"', answered))
        assert taken <= 2, f"{taken} edits of the same version of two files were taken"
    if not any(status.startswith(b"2") for status in statuses):
        raise RequestRefusedError(f"nothing was taken of {HOST}")
