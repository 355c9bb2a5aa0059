"""The server as a separate process, as a user starts it."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
import xml.etree.ElementTree as ET
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest

from counterspin import cli
from counterspin.application import server

IMAGES = Path(__file__).parents[2] / "docs" / "images"
#: Timeout of all waits, s; only a failure reaches it.
BOUND = 300.0
SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_server_prints_link_listens_on_loopback_and_stops_on_signal(tmp_path, how):
    words = [sys.executable, "-m", "counterspin", "serve", str(tmp_path), "--no-browser"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    (beside := tmp_path / "temporary").mkdir()
    server = subprocess.Popen(words, **pipes, env=os.environ | {"TMPDIR": str(beside)})
    with server, ExitStack() as stack:
        stack.callback(server.kill)
        assert "this machine only" in server.stdout.readline()
        link = re.search(r"http://127\.0\.0\.1:(\d+)/#token=(\S{32})", server.stdout.readline())
        port = int(link[1])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=BOUND) as answer:
            assert b"counterspin" in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/api/folder", timeout=BOUND)
        # A request that is not HTTP is rejected before or after a response and logs nothing.
        chunked = b"Host: 127.0.0.1:%d\r\nTransfer-Encoding: chunked\r\n\r\n" % port
        for request, status in ((b"\0", b"400"), (b"GET / HTTP/1.1\r\n" + chunked, b"200")):
            with socket.create_connection(("127.0.0.1", port), timeout=BOUND) as other:
                other.sendall(request)
                assert other.recv(1 << 16).startswith(b"HTTP/1.1 " + status)
                other.sendall(b"no length\r\n")
        # It listens on a single loopback address.
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port), timeout=5)
        # A link is valid once; the next link is printed after its use.
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/api/session",
            json.dumps({"token": link[2]}).encode(),
            {"Origin": f"http://127.0.0.1:{port}"},
        )
        with urllib.request.urlopen(request, timeout=BOUND) as answer:
            assert len(json.load(answer)["key"]) == 32
        assert "another browser or window" in server.stdout.readline()
        assert f"http://127.0.0.1:{port}/#token=" in (later := server.stdout.readline())
        assert link[2] not in later
        server.send_signal(how)
        out, err = server.communicate(timeout=BOUND)
    assert (server.returncode, out, err) == (0, "Server stopped.\n", "")
    assert list(beside.iterdir()) == []


def test_shutdown_waits_for_imports_in_progress(tmp_path, monkeypatch):
    """Python aborts if it exits during an import in a thread."""
    done = []

    def load(app, ended):
        assert ended.wait(BOUND)
        time.sleep(0.2)
        done.append(app)

    monkeypatch.setattr(server, "_preload_modules", load)
    monkeypatch.setattr(server, "make_server", lambda *_: SimpleNamespace(run=lambda **_: None))
    server.serve(tmp_path, browser=False, print_line=done.append)
    *_, loaded, last = done
    assert (type(loaded), last) == (server.AppState, "Server stopped.")


def test_browser_command_line_has_no_token(tmp_path, monkeypatch):
    """All users of the machine can read the list of processes."""
    opened, seen, printed_lines = threading.Event(), [], []

    def browse(address):
        file = Path(urllib.parse.urlsplit(address).path)
        modes = [path.stat().st_mode & 0o777 for path in (file, file.parent)]
        seen.extend((address, file, modes, file.read_text()))
        opened.set()

    monkeypatch.setattr("webbrowser.open", browse)
    monkeypatch.setattr(server, "_preload_modules", lambda *_: None)
    waiting = SimpleNamespace(run=lambda **_: opened.wait(BOUND))
    monkeypatch.setattr(server, "make_server", lambda *_: waiting)
    server.serve(tmp_path, print_line=printed_lines.append)
    address, file, modes, text = seen
    link = printed_lines[1].strip()
    assert address.startswith("file:///")
    assert link.partition("=")[2] not in address
    assert modes == [0o600, 0o700]
    assert f"url={link}" in text
    assert not file.parent.exists()


def test_windows_private_files_are_in_user_folder(tmp_path, monkeypatch):
    """File permissions have no effect on Windows, and users may share TEMP."""
    (mine := tmp_path / "mine").mkdir()
    private = []

    def write_redirect(folder, link):
        private.append((folder, link))
        return "file:///nowhere"

    monkeypatch.setattr(server, "_write_redirect", write_redirect)
    monkeypatch.setattr(server, "_preload_modules", lambda *_: None)
    monkeypatch.setattr(server, "make_server", lambda *_: SimpleNamespace(run=lambda **_: None))
    monkeypatch.setattr(server, "open_listener", lambda _: socket.socket())
    monkeypatch.setenv("LOCALAPPDATA", str(mine))
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr(socket.socket, "getsockname", lambda _: ("127.0.0.1", 1))
    monkeypatch.setattr("threading.Timer", lambda *_: SimpleNamespace(start=lambda: None))
    server.serve(tmp_path, print_line=lambda _: None)
    assert [folder.parent for folder, _ in private] == [mine]
    assert list(mine.iterdir()) == []


def test_windows_socket_uses_exclusive_address(monkeypatch):
    """On Windows SO_REUSEADDR would permit it."""
    options = []

    class Listener:
        def setsockopt(self, level, option, value):
            options.append((level, option, value))

        def bind(self, address): ...
        def listen(self): ...

    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr(socket, "SO_EXCLUSIVEADDRUSE", -5, raising=False)
    monkeypatch.setattr(socket, "socket", lambda *_: Listener())
    server.open_listener(0)
    assert options == [(socket.SOL_SOCKET, -5, 1)]


def test_occupied_port_and_missing_folder_raise_errors(tmp_path, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert cli.main(["serve", str(tmp_path), "--port", str(port)]) == 1
    assert f"port {port} " in (stderr := capsys.readouterr().err)
    assert "give another --port" in stderr
    assert cli.main(["serve", str(tmp_path), "--port", "99999"]) == 2
    assert cli.main(["serve", str(tmp_path / "nowhere")]) == 1
    assert "folder not found" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a" * 5000 + ".js", "..%2fserver.js", "%00.js", "%ff.css", ".js"])
def test_unknown_asset_returns_404(page, name):
    assert page.get(f"/assets/{name}").status_code == 404
    assert page.get("/api/folder/").status_code == 404


@pytest.mark.parametrize("name", ["accelerometer", "arm", "double-turntable", "tumble"])
def test_drawings_have_description_and_page_colours(anonymous, name):
    response = anonymous.get(f"/assets/machine-{name}.svg")
    assert response.headers["content-type"] == "image/svg+xml"
    drawing, printed = (
        ET.fromstring(response.text),
        ET.parse(IMAGES / f"machine-{name}.svg").getroot(),
    )
    assert drawing.get("role") == "img"
    for attribute, tag in (("aria-labelledby", "title"), ("aria-describedby", "desc")):
        element = drawing.find(f"{SVG}{tag}")
        assert element.get("id") == drawing.get(attribute)
        assert len(element.text) > 10
    # The page shows the drawing of the documentation except for colours and background.
    shapes = [(e.tag, e.get("d"), e.get("cx"), e.text) for e in drawing]
    background = f"M0 0H480V{printed.get('height')}H0Z"
    assert shapes == [
        (e.tag, e.get("d"), e.get("cx"), e.text) for e in printed if e.get("d") != background
    ]
    colours = re.findall('(?:fill|stroke):([^;"]+)', response.text)
    assert all(colour == "none" or colour.startswith("var(--") for colour in colours)
