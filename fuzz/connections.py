"""Malformed connections to the server of the application.

A case is several concurrent connections, as JSON: the bytes of each in pieces, with the order of
all pieces. Lengths and chunks contradict the headers, requests are truncated or followed by others,
and either end closes the connection. The protocol class of the server reads them in this process,
without a socket. Every answer must be complete, an aborted request must leave no file, only one of
several edits of a version may succeed, and the next request must be answered.

- `connections_format`: the format
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
from fuzz.application_client import (
    HOST,
    PORT,
    SECRET,
    InlineAppState,
    RequestRefusedError,
    WatchedFolder,
    fixed_credentials,
    unthreaded_application,
)
from fuzz.format import Format
from fuzz.mutations import mutate_bytes
from fuzz.requests import insert_ticket, make_request, prepare_folders, valid_requests

#: Prefixes of requests that take a few ms and start no process.
_FAST_REQUESTS = (
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

#: Incomplete requests of other connections.
_PARTIAL_REQUESTS = (
    "",
    "G",
    "GET / HTTP/1.1\r\nHost: ",
    f"POST /api/session HTTP/1.1\r\nHost: {HOST}\r\n",
)

#: Turns of the event loop after which a request is considered to hang.
_MAX_LOOP_TURNS = 400


def _encode_request(request: dict[str, Any]) -> tuple[bytes, bytes]:
    """Return head and body of a request as bytes."""
    lines = [f"{request['method']} {request['target']} HTTP/1.1"]
    lines += [f"{name}: {value}" for name, value in request["headers"]]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1"), request["body"].encode("latin-1")


def _mutate_request(rng: Random, request: dict[str, Any]) -> bytes:
    """Return the bytes of a request, possibly malformed."""
    head, body = _encode_request(request)
    mutation = rng.randrange(9)
    length = re.compile(rb"content-length: \d+")
    if mutation == 0:
        wrong_length = rng.choice((len(body) + 5, max(len(body) - 5, 0), 0, 10**7, 10**19, -1))
        head = length.sub(b"content-length: %d" % wrong_length, head)
    elif mutation == 1:
        head = length.sub(b"transfer-encoding: chunked", head)
        chunks = [body[i : i + 90] for i in range(0, len(body), 90)]
        body = b"".join(b"%x\r\n%s\r\n" % (len(chunk), chunk) for chunk in chunks) + b"0\r\n\r\n"
        if rng.random() < 0.5:
            body = mutate_bytes(rng, body)
    elif mutation == 2:
        head = mutate_bytes(rng, head)
    elif mutation == 3:
        body += rng.choice((b"\r\n", b"x" * 70000, head + body, b"\0", b"GET / HTTP/1.1\r\n\r\n"))
    elif mutation == 4:
        body = body[: rng.randrange(len(body) + 1)]
    elif mutation == 5:
        head = head[: rng.randrange(len(head))]
        body = b""
    elif mutation == 6:
        extra_header = rng.choice(
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
        head = head[:-2] + extra_header + b"\r\n\r\n"
    return head + body


def draw_case(rng: Random, valid: dict[str, tuple[str, str, Any]]) -> bytes:
    """Return several concurrent connections as JSON."""
    names = [name for name in valid if name.startswith(_FAST_REQUESTS)]
    # Of several simultaneous edits of one file, only one is accepted.
    common_request = rng.choice(names) if rng.random() < 0.3 else None
    timed_pieces = []
    for number in range(rng.choice((1, 1, 2, 5))):
        content = b""
        for _ in range(rng.choice((1, 1, 2, 3))):
            content += _mutate_request(
                rng, make_request(*valid[common_request or rng.choice(names)])
            )
        n_pieces = rng.choice((1, 2, 5))
        cuts = sorted(rng.randrange(len(content) + 1) for _ in range(n_pieces - 1))
        pieces = [content[a:b] for a, b in zip([0, *cuts], [*cuts, len(content)], strict=True)]
        timed_pieces += [(rng.random(), number, piece.decode("latin-1")) for piece in pieces]
    # Interleave the connections, with the pieces of each in order.
    times = sorted(time for time, _, _ in timed_pieces)
    steps: list[list[Any]] = []
    for number in {number for _, number, _ in timed_pieces}:
        own_pieces = [piece for _, owner, piece in timed_pieces if owner == number]
        own_times = sorted(rng.sample(times, len(own_pieces)))
        steps += [[time, number, piece] for time, piece in zip(own_times, own_pieces, strict=True)]
    steps.sort(key=lambda step: (step[0], step[1]))
    ends = {str(n): rng.choice(("wait", "leave", "leave at once")) for n in {s[1] for s in steps}}
    crowd = [rng.choice(_PARTIAL_REQUESTS)] * rng.choice((0, 0, 3, 137))
    plan = {"pieces": [step[1:] for step in steps], "ends": ends, "crowd": crowd}
    return json.dumps(plan).encode()


class _RecordingTransport(asyncio.Transport):
    """Server end of a connection that records the written bytes."""

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
        """Do nothing: there is no flow control."""

    def resume_reading(self) -> None:
        """Do nothing: there is no flow control."""


class _ErrorLog(logging.Handler):
    """Log handler that collects the error messages of the server."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            self.messages.append(logging.Formatter().format(record))


class _Server:
    """The server's protocol over a folder."""

    def __init__(self, app_state: InlineAppState, app: Any) -> None:
        self.config = make_server(app_state, fixed_credentials()).config
        self.config.load()
        self.config.loaded_app = app
        self.state = ServerState()

    def connect(self) -> TimedConnection:
        """Return the server's side of a new connection."""
        make_protocol: Any = self.config.http_protocol_class
        loop = asyncio.get_running_loop()
        connection: TimedConnection = make_protocol(
            config=self.config, server_state=self.state, app_state={}, _loop=loop
        )
        connection.connection_made(_RecordingTransport())
        return connection

    async def settle(self) -> None:
        """Run the event loop until no request is in progress, or all wait for more data."""
        for _ in range(_MAX_LOOP_TURNS):
            await asyncio.sleep(0)
            if not self.state.tasks:
                return


async def _run_connections(
    app_state: InlineAppState, watched: WatchedFolder, plan: dict[str, Any]
) -> list[bytes]:
    """Run the connections of a case; return the answer bytes of each."""
    tracebacks: list[str] = []
    with unthreaded_application(app_state, tracebacks) as app, watched.forbid_outside_access():
        server = _Server(app_state, app)
        connections_by_number: dict[int, TimedConnection] = {}
        disconnected: set[int] = set()
        for number, piece in plan["pieces"]:
            if number not in connections_by_number:
                connections_by_number[number] = server.connect()
            # An empty piece would signal the end of the connection.
            if (
                piece
                and number not in disconnected
                and not connections_by_number[number].transport.is_closing()
            ):
                connections_by_number[number].data_received(
                    insert_ticket(app_state, piece).encode("latin-1")
                )
            await asyncio.sleep(0)
            if plan["ends"][str(number)] == "leave at once" and number % 2:
                connections_by_number[number].connection_lost(None)
                disconnected.add(number)
        for number, end in plan["ends"].items():
            if end == "wait":
                continue
            connections_by_number[int(number)].eof_received()
            connections_by_number[int(number)].connection_lost(None)
        await server.settle()
        before = watched.state()
        crowd = [server.connect() for _ in plan["crowd"]]
        for connection, partial_request in zip(crowd, plan["crowd"], strict=True):
            if partial_request:
                connection.data_received(partial_request.encode("latin-1"))
        final_connection = server.connect()
        final_connection.data_received(_encode_request(make_request("GET", "/api/jobs", {}))[0])
        await asyncio.sleep(0)
        for _ in range(_MAX_LOOP_TURNS):
            await asyncio.sleep(0)
            if b"\r\n\r\n" in final_connection.transport.written:
                break
        assert final_connection.transport.written.startswith(b"HTTP/1.1 200"), (
            "the next request is not answered"
        )
        for connection in (*connections_by_number.values(), *crowd, final_connection):
            connection.connection_lost(None)
            connection._unset_keepalive_if_required()
        await server.settle()
        assert not server.state.tasks, "a request hangs after all clients have disconnected"
        after = watched.state()
    assert not tracebacks, tracebacks[0]
    # An incomplete request must leave no file.
    removed = {name for name in before if name not in after}
    added = {name for name in after if name not in watched.initial_state}
    hidden = {name for name in added if Path(name).name.startswith(".")}
    assert not hidden, f"left: {sorted(hidden)}"
    assert all(Path(name).name.startswith(".") or name == "new" for name in removed), removed
    lost = {name for name in watched.initial_state if name not in after}
    assert not lost, f"lost: {sorted(lost)}"
    return [connection.transport.written for connection in connections_by_number.values()]


def connections_format(folder: Path) -> Format:
    """Return the format of connections to the application."""
    template, watched = prepare_folders(folder)
    valid = valid_requests(template)
    app_state = InlineAppState(ServedFolder(watched.folder))

    def read(path: Path) -> None:
        plan = json.loads(path.read_bytes())
        error_log = _ErrorLog()
        for name in ("uvicorn.error", "asyncio"):
            logging.getLogger(name).addHandler(error_log)
        try:
            answers = asyncio.run(_run_connections(app_state, watched, plan))
        finally:
            for name in ("uvicorn.error", "asyncio"):
                logging.getLogger(name).removeHandler(error_log)
            watched.restore()
        assert not error_log.messages, error_log.messages[0]
        _check_answers(plan, b"".join(answers))

    return Format(".json", lambda rng: draw_case(rng, valid), read)


def _check_answers(plan: dict[str, Any], answers: bytes) -> None:
    statuses = re.findall(rb"HTTP/1\.1 (\d\d\d)", answers)
    assert not any(status >= b"500" for status in statuses), statuses
    assert SECRET.encode() not in answers
    sent = "".join(piece for _, piece in plan["pieces"])
    if sent.count("PUT /api/text") > 1 and '"version": ""' not in sent:
        n_accepted = len(re.findall(rb'"file":"(three/campaign|LAB)\.toml","version"', answers))
        assert n_accepted <= 2, f"{n_accepted} edits of one version of two files were accepted"
    if not any(status.startswith(b"2") for status in statuses):
        raise RequestRefusedError(f"nothing was accepted by {HOST}")
