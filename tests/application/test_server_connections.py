"""The page responds despite many unauthenticated connections."""

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress

import pytest
from served import read_token, run_server

from counterspin.application import access_control, server
from counterspin.application.server import TimedConnection

#: Timeout of all waits, s; only a failure reaches it.
BOUND = 300.0
HALF = b"GET /api/folder HTTP/1.1\r\nHost: 127.0"


def _request_page(port, key):
    """Return the status of a page request and its duration, s."""
    begun = time.monotonic()
    HTTPConnection = http.client.HTTPConnection("127.0.0.1", port, timeout=BOUND)
    HTTPConnection.request("GET", "/api/folder", headers={"Authorization": f"Bearer {key}"})
    with HTTPConnection.getresponse() as answer:
        answer.read()
    HTTPConnection.close()
    return answer.status, time.monotonic() - begun


def test_unauthenticated_connections_do_not_block_server(tmp_path):
    """Open more incomplete connections than descriptors, then send 100 complete requests."""
    limited = ["sh", "-c", 'ulimit -n 256; exec "$@"', "sh"]
    words = [*limited, sys.executable, "-m", "counterspin", "serve", str(tmp_path), "--no-browser"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    connections = []
    with subprocess.Popen(words, **pipes) as server:
        server.stdout.readline()
        link = re.search(r":(\d+)/#token=(\S+)", server.stdout.readline())
        port = int(link[1])
        HTTPConnection = http.client.HTTPConnection("127.0.0.1", port, timeout=BOUND)
        headers = {"Origin": f"http://127.0.0.1:{port}"}
        HTTPConnection.request("POST", "/api/session", json.dumps({"token": link[2]}), headers)
        with HTTPConnection.getresponse() as answer:
            key = json.load(answer)["key"]
        HTTPConnection.close()
        whole = f"GET /api/folder HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        taken = []
        for sent, number in ((HALF, 300), (whole, 100)):
            for _ in range(number):
                connections.append(socket.create_connection(("127.0.0.1", port), timeout=BOUND))
                connections[-1].sendall(sent)
            taken.append(_request_page(port, key))
        server.send_signal(signal.SIGINT)
        out, err = server.communicate(timeout=BOUND)
    for connection in connections:
        connection.close()
    assert [status for status, _ in taken] == [200, 200]
    # It takes milliseconds; without free descriptors it took 40 s.
    assert max(seconds for _, seconds in taken) < 30.0
    assert (server.returncode, out.splitlines()[-1], err) == (0, "Server stopped.", "")


@pytest.fixture
def server_credentials(app):
    """Return the credentials of a running server."""
    with run_server(app) as credentials:
        yield credentials


def _wait_closed(connection):
    """Wait until the peer has closed a connection."""
    with suppress(ConnectionResetError):
        while connection.recv(1 << 16):
            pass


def _send_slowly(connection):
    end = time.monotonic() + BOUND
    while time.monotonic() < end:
        connection.sendall(b"x")
        time.sleep(0.05)


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        HALF,
        b"POST /api/session HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: http://127.0.0.1:%d\r\n"
        b"Content-Length: 1000\r\n\r\n{",
    ],
    ids=["nothing", "half a head", "half a body"],
)
def test_incomplete_request_times_out(server_credentials, monkeypatch, sent):
    monkeypatch.setattr(server, "HEAD_TIMEOUT", 0.2)
    monkeypatch.setattr(access_control, "UNAUTHENTICATED_TIMEOUT", 0.2)
    sent = sent.replace(b"%d", str(server_credentials.port).encode())
    with socket.create_connection(
        ("127.0.0.1", server_credentials.port), timeout=BOUND
    ) as connection:
        connection.sendall(sent)
        # Occasional bytes do not extend the timeout.
        with pytest.raises(ConnectionError):
            _send_slowly(connection)


def test_unauthenticated_request_is_read_in_part(server_credentials):
    head = f"POST /api/jobs HTTP/1.1\r\nHost: 127.0.0.1:{server_credentials.port}\r\n"
    head += f"Origin: http://127.0.0.1:{server_credentials.port}\r\nContent-Length: 4000000\r\n\r\n"
    read = []
    before = TimedConnection.data_received

    def receive_and_record(protocol, data):
        read.append(len(data))
        before(protocol, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TimedConnection, "data_received", receive_and_record)
        with socket.create_connection(
            ("127.0.0.1", server_credentials.port), timeout=BOUND
        ) as connection:
            connection.settimeout(BOUND)
            with suppress(ConnectionError):
                connection.sendall(head.encode() + b"x" * 3_900_000)
            _wait_closed(connection)
    # asyncio reads 256 KiB at once; uvicorn pauses beyond 64 KiB of a body.
    assert 0 < sum(read) <= 2 * 2**18


def test_idle_authenticated_connection_stays_open(server_credentials, monkeypatch):
    monkeypatch.setattr(server, "_MAX_CONNECTIONS", 3)
    key = server_credentials.exchange_token(read_token(server_credentials))
    page = http.client.HTTPConnection("127.0.0.1", server_credentials.port, timeout=BOUND)
    connections = []
    for _ in range(3):
        page.request("GET", "/api/jobs", headers={"Authorization": f"Bearer {key}"})
        assert page.getresponse().read() == b"[]"
        socket_before = page.sock
        for _ in range(5):
            connections.append(
                socket.create_connection(("127.0.0.1", server_credentials.port), timeout=BOUND)
            )
        _wait_closed(connections[-4])
    assert page.sock is socket_before
    for connection in connections:
        connection.close()
    page.close()
