"""The application asked in this process, and what must hold of its answers and of its files.

- `PORT`, `HOST`, `TOKEN`, `KEY`: who is asked; the key is known here, so that cases come out the
  same again
- `InlineAppState`: a folder that is served, whose jobs are done at once
- `asking`: the application, called without threads
- `ask`: one request; `HasAnswer`: what came of it; `require_right`: what must hold of that
- `RequestRefusedError`: it was refused as it should be
- `Watched`: no file beside the folder is touched, and none in it is lost
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from served import InlineJobs, run_inline

from counterspin.application import endpoints, server
from counterspin.application.access_control import SESSION_PATH, TICKET_PATH, Credentials
from counterspin.application.app_state import AppState
from counterspin.application.campaign_files import TRASH_FOLDER
from counterspin.application.served_folder import ServedFolder
from counterspin.errors import CounterspinError

#: Who is asked, and what opens it: the token once, the key always.
PORT = 8765
HOST = f"127.0.0.1:{PORT}"
TOKEN, KEY = "t" * 32, "k" * 32


def fixed_credentials() -> Credentials:
    """Return the fixed_credentials of a server that nobody has entered yet."""
    return Credentials(PORT, TOKEN, KEY)


#: What stands in files beside the folder, and in no answer.
SECRET = "counterspin-fuzz-secret"


class _First:
    """Campaigns followed to their first state, in this process."""

    def look(self, campaign: Path, goal: str) -> dict[str, Any]:
        from counterspin.monitoring.watch import watch

        try:
            state = next(iter(watch(campaign, goals=[goal] if goal else [])))
        except CounterspinError as error:
            return {"error": str(error)}
        return {"html": "", "events": list(state.events), "complete": state.complete}

    def ask(self, file: Path, work: Callable[..., None], question: Any) -> Any:
        kind, *told = run_inline(work, file, questions=[question])[-1]
        if kind == "failed":
            assert "internal error" not in told[0], told[0]
            raise CounterspinError(told[0])
        return told[-1]

    def end(self, file: Path) -> None:
        """Nothing goes on about a file."""

    def close(self) -> None:
        """Nothing is followed any longer."""


class InlineAppState(AppState):
    """Application state whose jobs are done at once."""

    def __init__(self, folder: ServedFolder) -> None:
        super().__init__(folder)
        self.jobs = InlineJobs()
        self.live = _First()  # type: ignore[assignment]


async def _directly(function: Callable[..., Any], *words: Any) -> Any:
    """Call what a server would call in a thread: what goes wrong is then seen where it does."""
    return function(*words)


class HasAnswer:
    """What came of a request: status (0: none), headers, body, and what it raised."""

    def __init__(self) -> None:
        self.status = 0
        self.headers: dict[str, str] = {}
        self.body = b""
        self.ended = False


async def ask(app: Any, request: dict[str, Any]) -> HasAnswer:
    """Ask as a server does, in this process.

    Parameters
    ----------
    app
        The application.
    request
        Of a case; `gone`: who asks goes away before the last piece.
    """
    answered = HasAnswer()
    path, _, query = request["target"].partition("?")
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": request["method"],
        "scheme": "http",
        "path": unquote_to_bytes(path.encode("latin-1")).decode("utf-8", "replace"),
        "raw_path": path.encode("latin-1"),
        "query_string": query.encode("latin-1"),
        "root_path": "",
        "headers": [(n.encode("latin-1"), v.encode("latin-1")) for n, v in request["headers"]],
        "client": ("127.0.0.1", 50000),
        "server": ("127.0.0.1", PORT),
    }
    body, pieces = request["body"].encode("latin-1"), request["pieces"]
    width = len(body) // pieces + 1
    parts = [body[i * width : (i + 1) * width] for i in range(pieces)]
    messages = [
        {"type": "http.request", "body": part, "more_body": i < pieces - 1}
        for i, part in enumerate(parts)
    ]
    if request["gone"]:
        messages.pop()
    left = iter(messages)

    async def receive() -> dict[str, Any]:
        return next(left, {"type": "http.disconnect"})

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            assert not answered.status, "two answers"
            answered.status = message["status"]
            answered.headers = {
                n.decode("latin-1"): v.decode("latin-1") for n, v in message["headers"]
            }
        else:
            answered.body += message.get("body", b"")
            answered.ended = not message.get("more_body", False)

    await app(scope, receive, send)
    return answered


def require_right(request: dict[str, Any], answered: HasAnswer, raised: str) -> None:
    """Raise AssertionError of an answer that should not be; RequestRefusedError of a refusal."""
    assert answered.status < 500, f"status {answered.status}\n{raised}\n{answered.body[:500]!r}"
    if not answered.status:
        assert request["gone"], "no answer"
        return
    assert answered.ended, "half an answer"
    assert SECRET.encode() not in answered.body, "what is outside was told"
    for name in ("content-security-policy", "x-content-type-options", "cache-control"):
        assert name in answered.headers, f"no {name}"
    if request["stranger"] and (
        request["stranger"] in ("host", "origin")
        or (request["target"].startswith("/api/") and not request["target"].startswith(_OPEN))
    ):
        assert answered.status >= 400, f"a stranger was let in by {request['stranger']}"
    if answered.status < 400:
        return
    if (
        answered.headers.get("content-type", "").startswith("application/json")
        and request["method"] != "HEAD"
    ):
        words = json.loads(answered.body)["error"]
        assert isinstance(words, str)
        assert words, "no words"
        assert "internal error" not in words, words
        assert "Traceback" not in words, words
        assert len(words) < _CHARACTERS, f"a message of {len(words)} characters\n{words[:300]}"
    raise RequestRefusedError(f"status {answered.status}")


class RequestRefusedError(CounterspinError):
    """All requests of a case were answered as they should be, and the last one was refused."""


_CHARACTERS = 20_000

#: What is asked of without the key: an address that counts once, and the key itself.
_OPEN = (SESSION_PATH, TICKET_PATH)


# Files


#: Names of files and folders -> what tells whether they were changed.
State = dict[str, tuple[int, int, int, int]]


class Watched:
    """A folder in which nothing may be lost, beside one of which nothing may be touched.

    Parameters
    ----------
    folder
        What is served; it is as it was after each case.
    template
        What it is to be.
    """

    def __init__(self, folder: Path, template: Path) -> None:
        self.folder = folder
        self._template = template
        self._root = os.path.realpath(folder)
        self._beside = os.path.realpath(folder.parent / "outside")
        self._wrong: list[str] = []
        shutil.copytree(template, folder, symlinks=True, copy_function=_copied)
        self.first = self.state()

    def state(self) -> State:
        """Return each file and folder of the folder, with what tells whether it was changed."""
        found = {}
        waiting = [""]
        while waiting:
            inner = waiting.pop()
            with os.scandir(self._root + os.sep + inner) as entries:
                for entry in entries:
                    status = entry.stat(follow_symlinks=False)
                    name = inner + entry.name
                    if stat.S_ISDIR(status.st_mode):
                        waiting.append(name + os.sep)
                        found[name] = (status.st_mode, 0, 0, 0)
                    else:
                        about = (status.st_ino, status.st_size, status.st_mtime_ns)
                        found[name] = (status.st_mode, *about)
        return found

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Raise AssertionError if a file outside is touched meanwhile."""
        _hook()
        self._wrong.clear()
        _LOOKING.append(self._seen)
        try:
            yield
        finally:
            _LOOKING.remove(self._seen)
        assert not self._wrong, self._wrong[:3]

    def _seen(self, event: str, words: tuple[Any, ...]) -> None:
        writes = event != "open"
        if event == "open":
            flags = words[2]
            writes = bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))
            words = words[:1]
        elif event in ("os.listdir", "os.scandir"):
            writes = False
        beside = words[-1] if isinstance(words[-1], int) else -1
        for word in words[:2]:
            if not isinstance(word, str | bytes | os.PathLike):
                continue
            base = f"/proc/self/fd/{beside}" if beside >= 0 else "."
            path = os.path.realpath(os.path.join(base, os.fsdecode(word)))  # noqa: PTH118
            inside = path == self._root or path.startswith(self._root + os.sep)
            if path.startswith(self._beside):
                self._wrong.append(f"outside was touched: {event} {path}")
            elif "__pycache__" in path:  # Python compiles a module that is imported here first.
                continue
            elif writes and not inside and not path.startswith(_TEMPORARY):
                self._wrong.append(f"written outside: {event} {path}")

    def require_whole(self, request: dict[str, Any], status: int, before: State) -> State:
        """Return the state; AssertionError if files were changed that should not have been."""
        after = self.state()
        changed = {name for name in before | after if before.get(name) != after.get(name)}
        if not changed:
            return after
        what = f"{request['method']} {request['target'][:80]}, status {status}"
        assert 200 <= status < 300, f"{what}: has changed {sorted(changed)[:4]}"
        assert request["method"] not in ("GET", "HEAD"), (
            f"{what}: has changed {sorted(changed)[:4]}"
        )
        lost = {name for name in changed if name in before and name not in after}
        if request["target"].partition("?")[0] in _MOVING:
            there = {after[name] for name in changed if name in after}
            moved = {name for name in lost if before[name] in there}
            changed, lost = changed - moved, lost - moved
        assert not lost, f"{what}: has lost {sorted(lost)[:4]}"
        hidden = {name for name in changed if os.path.basename(name).startswith(".")}  # noqa: PTH119
        hidden -= {TRASH_FOLDER}
        assert not hidden, f"{what}: has left {sorted(hidden)[:4]}"
        kept = [name for name in changed if name in before]
        assert len(kept) <= 1, f"{what}: has changed {sorted(kept)[:4]}"
        return after

    def restore(self) -> None:
        """Make the folder what it was."""
        now = self.state()
        for name in sorted(now, reverse=True):
            if now[name] != self.first.get(name):
                path = os.path.join(self._root, name)  # noqa: PTH118
                with suppress(FileNotFoundError):
                    (shutil.rmtree if stat.S_ISDIR(now[name][0]) else os.remove)(path)
        if self.state() != self.first:
            for name in self.first:
                path = os.path.join(self._root, name)  # noqa: PTH118
                if not os.path.lexists(path):
                    source = os.path.join(self._template, name)  # noqa: PTH118
                    if stat.S_ISDIR(self.first[name][0]):
                        os.mkdir(path)  # noqa: PTH102
                    else:
                        _copied(source, path)
            self.first = self.state()


#: Requests after which a campaign's files have other names.
_MOVING = ("/api/rename", "/api/put-away", "/api/restore")
_TEMPORARY = tuple({os.path.realpath(place) for place in ("/tmp", "/dev/shm", "/dev/null")})
_LOOKING: list[Callable[[str, tuple[Any, ...]], None]] = []
_HOOKED: list[bool] = []
_EVENTS = frozenset(
    ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.chmod")
) | {"os.listdir", "os.scandir", "os.truncate", "shutil.rmtree", "shutil.copyfile", "os.utime"}


def _hook() -> None:
    """Have every file that Python opens told, from now on; a hook cannot be taken away."""
    if _HOOKED:
        return
    _HOOKED.append(True)

    def heard(event: str, words: tuple[Any, ...]) -> None:
        if _LOOKING and event in _EVENTS:
            for look in _LOOKING:
                look(event, words)

    sys.addaudithook(heard)


def _copied(source: Any, place: Any) -> Any:
    """Copy a file, a link or a pipe."""
    if stat.S_ISFIFO(os.lstat(source).st_mode):
        os.mkfifo(place)
        return place
    return shutil.copy2(source, place, follow_symlinks=False)


@contextmanager
def asking(app_state: InlineAppState, raised: list[str]) -> Iterator[Any]:
    """Yield the application without threads; `raised` takes tracebacks of what nobody foresaw."""
    before, failed = server.run_in_threadpool, endpoints._unexpected_error_response

    def noted(error: Exception) -> endpoints.ApiResponse:
        made = failed(error)
        if made.status == 500:
            raised.append("".join(traceback.format_exception(error)))
        return made

    server.run_in_threadpool = _directly  # type: ignore[assignment]
    endpoints._unexpected_error_response = noted
    try:
        yield server.make_application(app_state, fixed_credentials())
    finally:
        server.run_in_threadpool, endpoints._unexpected_error_response = before, failed
