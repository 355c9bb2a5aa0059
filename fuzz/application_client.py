"""Send requests to the application in this process; check its responses and files.

- `PORT`, `HOST`, `TOKEN`, `KEY`: address and fixed credentials, so that cases are reproducible
- `InlineAppState`: application state that runs jobs immediately
- `unthreaded_application`: the application, called without threads
- `send_request`: send one request; `Response`: its response; `check_response`: check it
- `RequestRefusedError`: a correctly refused request
- `WatchedFolder`: checks that no outside file is accessed, and no file in the folder is lost
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

#: Address of the server and its credentials: single-use token, session key.
PORT = 8765
HOST = f"127.0.0.1:{PORT}"
TOKEN, KEY = "t" * 32, "k" * 32


def fixed_credentials() -> Credentials:
    """Return the credentials of a server without sessions."""
    return Credentials(PORT, TOKEN, KEY)


#: Content of files outside the folder, which must not appear in any response.
SECRET = "counterspin-fuzz-secret"


class _FirstStateMonitor:
    """Live monitor that stops at the first state of a campaign, in this process."""

    def look(self, campaign: Path, goal: str) -> dict[str, Any]:
        from counterspin.monitoring.watch import watch

        try:
            state = next(iter(watch(campaign, goals=[goal] if goal else [])))
        except CounterspinError as error:
            return {"error": str(error)}
        return {"html": "", "events": list(state.events), "complete": state.complete}

    def ask(self, file: Path, work: Callable[..., None], question: Any) -> Any:
        kind, *details = run_inline(work, file, questions=[question])[-1]
        if kind == "failed":
            assert "internal error" not in details[0], details[0]
            raise CounterspinError(details[0])
        return details[-1]

    def end(self, file: Path) -> None:
        """Do nothing: no work is in progress."""

    def close(self) -> None:
        """Do nothing: no campaign is monitored."""


class InlineAppState(AppState):
    """Application state that runs jobs immediately."""

    def __init__(self, folder: ServedFolder) -> None:
        super().__init__(folder)
        self.jobs = InlineJobs()
        self.live = _FirstStateMonitor()  # type: ignore[assignment]


async def _call_directly(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function without a thread, so that exceptions keep their traceback."""
    return function(*arguments)


class Response:
    """Response to a request: status (0: none), headers, body, and whether it is complete."""

    def __init__(self) -> None:
        self.status = 0
        self.headers: dict[str, str] = {}
        self.body = b""
        self.ended = False


async def send_request(app: Any, request: dict[str, Any]) -> Response:
    """Call the application as a server does, in this process; return its response.

    Parameters
    ----------
    app
        The application.
    request
        Request of a case; `gone`: the client disconnects before the last chunk.
    """
    response = Response()
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
    body, n_chunks = request["body"].encode("latin-1"), request["pieces"]
    chunk_length = len(body) // n_chunks + 1
    chunks = [body[i * chunk_length : (i + 1) * chunk_length] for i in range(n_chunks)]
    messages = [
        {"type": "http.request", "body": chunk, "more_body": i < n_chunks - 1}
        for i, chunk in enumerate(chunks)
    ]
    if request["gone"]:
        messages.pop()
    remaining = iter(messages)

    async def receive() -> dict[str, Any]:
        return next(remaining, {"type": "http.disconnect"})

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            assert not response.status, "two answers"
            response.status = message["status"]
            response.headers = {
                n.decode("latin-1"): v.decode("latin-1") for n, v in message["headers"]
            }
        else:
            response.body += message.get("body", b"")
            response.ended = not message.get("more_body", False)

    await app(scope, receive, send)
    return response


def check_response(request: dict[str, Any], response: Response, traceback_text: str) -> None:
    """Raise AssertionError for an incorrect response, RequestRefusedError for a correct refusal."""
    assert response.status < 500, (
        f"status {response.status}\n{traceback_text}\n{response.body[:500]!r}"
    )
    if not response.status:
        assert request["gone"], "no response"
        return
    assert response.ended, "half an response"
    assert SECRET.encode() not in response.body, "content from outside the folder was returned"
    for name in ("content-security-policy", "x-content-type-options", "cache-control"):
        assert name in response.headers, f"no {name}"
    if request["stranger"] and (
        request["stranger"] in ("host", "origin")
        or (
            request["target"].startswith("/api/")
            and not request["target"].startswith(_PUBLIC_PATHS)
        )
    ):
        assert response.status >= 400, (
            f"an unauthorised request was accepted ({request['stranger']})"
        )
    if response.status < 400:
        return
    if (
        response.headers.get("content-type", "").startswith("application/json")
        and request["method"] != "HEAD"
    ):
        message = json.loads(response.body)["error"]
        assert isinstance(message, str)
        assert message, "no message"
        assert "internal error" not in message, message
        assert "Traceback" not in message, message
        assert len(message) < _MAX_MESSAGE_LENGTH, (
            f"a message of {len(message)} characters\n{message[:300]}"
        )
    raise RequestRefusedError(f"status {response.status}")


class RequestRefusedError(CounterspinError):
    """All requests of a case were answered correctly, and the last one was refused."""


_MAX_MESSAGE_LENGTH = 20_000

#: Paths that need no key: exchange of the token, and of a ticket.
_PUBLIC_PATHS = (SESSION_PATH, TICKET_PATH)


# Files


#: Path -> mode, inode, size and modification time of a file or folder.
State = dict[str, tuple[int, int, int, int]]


class WatchedFolder:
    """A served folder that must lose no file, next to a folder that must not be accessed.

    Parameters
    ----------
    folder
        The served folder; restored after each case.
    template
        Folder with its initial content.
    """

    def __init__(self, folder: Path, template: Path) -> None:
        self.folder = folder
        self._template = template
        self._root = os.path.realpath(folder)
        self._outside = os.path.realpath(folder.parent / "outside")
        self._violations: list[str] = []
        shutil.copytree(template, folder, symlinks=True, copy_function=_copy_entry)
        self.initial_state = self.state()

    def state(self) -> State:
        """Return path -> fingerprint of each file and folder in the folder."""
        entries_by_name = {}
        pending = [""]
        while pending:
            subfolder = pending.pop()
            with os.scandir(self._root + os.sep + subfolder) as entries:
                for entry in entries:
                    status = entry.stat(follow_symlinks=False)
                    name = subfolder + entry.name
                    if stat.S_ISDIR(status.st_mode):
                        pending.append(name + os.sep)
                        entries_by_name[name] = (status.st_mode, 0, 0, 0)
                    else:
                        fingerprint = (status.st_ino, status.st_size, status.st_mtime_ns)
                        entries_by_name[name] = (status.st_mode, *fingerprint)
        return entries_by_name

    @contextmanager
    def forbid_outside_access(self) -> Iterator[None]:
        """Raise AssertionError if a file outside is accessed in the block."""
        _install_audit_hook()
        self._violations.clear()
        _OBSERVERS.append(self._check_event)
        try:
            yield
        finally:
            _OBSERVERS.remove(self._check_event)
        assert not self._violations, self._violations[:3]

    def _check_event(self, event: str, arguments: tuple[Any, ...]) -> None:
        is_write = event != "open"
        if event == "open":
            flags = arguments[2]
            is_write = bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))
            arguments = arguments[:1]
        elif event in ("os.listdir", "os.scandir"):
            is_write = False
        folder_descriptor = arguments[-1] if isinstance(arguments[-1], int) else -1
        for argument in arguments[:2]:
            if not isinstance(argument, str | bytes | os.PathLike):
                continue
            base = f"/proc/self/fd/{folder_descriptor}" if folder_descriptor >= 0 else "."
            path = os.path.realpath(os.path.join(base, os.fsdecode(argument)))  # noqa: PTH118
            is_inside = path == self._root or path.startswith(self._root + os.sep)
            if path.startswith(self._outside):
                self._violations.append(f"outside was touched: {event} {path}")
            elif "__pycache__" in path:  # Python compiles a module that is imported here first.
                continue
            elif is_write and not is_inside and not path.startswith(_TEMPORARY_FOLDERS):
                self._violations.append(f"written outside: {event} {path}")

    def check_changes(self, request: dict[str, Any], status: int, before: State) -> State:
        """Return the state; raise AssertionError if files were changed unexpectedly."""
        after = self.state()
        changed = {name for name in before | after if before.get(name) != after.get(name)}
        if not changed:
            return after
        description = f"{request['method']} {request['target'][:80]}, status {status}"
        assert 200 <= status < 300, f"{description}: has changed {sorted(changed)[:4]}"
        assert request["method"] not in ("GET", "HEAD"), (
            f"{description}: has changed {sorted(changed)[:4]}"
        )
        lost = {name for name in changed if name in before and name not in after}
        if request["target"].partition("?")[0] in _RENAMING_PATHS:
            entries_after = {after[name] for name in changed if name in after}
            moved = {name for name in lost if before[name] in entries_after}
            changed, lost = changed - moved, lost - moved
        assert not lost, f"{description}: has lost {sorted(lost)[:4]}"
        hidden = {name for name in changed if os.path.basename(name).startswith(".")}  # noqa: PTH119
        hidden -= {TRASH_FOLDER}
        assert not hidden, f"{description}: has left {sorted(hidden)[:4]}"
        modified = [name for name in changed if name in before]
        assert len(modified) <= 1, f"{description}: has changed {sorted(modified)[:4]}"
        return after

    def restore(self) -> None:
        """Restore the initial content of the folder."""
        current = self.state()
        for name in sorted(current, reverse=True):
            if current[name] != self.initial_state.get(name):
                path = os.path.join(self._root, name)  # noqa: PTH118
                with suppress(FileNotFoundError):
                    (shutil.rmtree if stat.S_ISDIR(current[name][0]) else os.remove)(path)
        if self.state() != self.initial_state:
            for name in self.initial_state:
                path = os.path.join(self._root, name)  # noqa: PTH118
                if not os.path.lexists(path):
                    source = os.path.join(self._template, name)  # noqa: PTH118
                    if stat.S_ISDIR(self.initial_state[name][0]):
                        os.mkdir(path)  # noqa: PTH102
                    else:
                        _copy_entry(source, path)
            self.initial_state = self.state()


#: Requests that rename the files of a campaign.
_RENAMING_PATHS = ("/api/rename", "/api/put-away", "/api/restore")
_TEMPORARY_FOLDERS = tuple(
    {os.path.realpath(folder) for folder in ("/tmp", "/dev/shm", "/dev/null")}
)
_OBSERVERS: list[Callable[[str, tuple[Any, ...]], None]] = []
_IS_HOOKED: list[bool] = []
_FILE_EVENTS = frozenset(
    ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.chmod")
) | {"os.listdir", "os.scandir", "os.truncate", "shutil.rmtree", "shutil.copyfile", "os.utime"}


def _install_audit_hook() -> None:
    """Notify observers of file access from now on; audit hooks cannot be removed."""
    if _IS_HOOKED:
        return
    _IS_HOOKED.append(True)

    def notify_observers(event: str, arguments: tuple[Any, ...]) -> None:
        if _OBSERVERS and event in _FILE_EVENTS:
            for observe in _OBSERVERS:
                observe(event, arguments)

    sys.addaudithook(notify_observers)


def _copy_entry(source: Any, target: Any) -> Any:
    """Copy a file, a link or a named pipe."""
    if stat.S_ISFIFO(os.lstat(source).st_mode):
        os.mkfifo(target)
        return target
    return shutil.copy2(source, target, follow_symlinks=False)


@contextmanager
def unthreaded_application(app_state: InlineAppState, tracebacks: list[str]) -> Iterator[Any]:
    """Yield the application without threads; append unexpected errors to `tracebacks`."""
    run_in_threadpool, make_error_response = (
        server.run_in_threadpool,
        endpoints._unexpected_error_response,
    )

    def record_error(app: AppState, error: Exception) -> endpoints.ApiResponse:
        response = make_error_response(app, error)
        if response.status == 500:
            tracebacks.append("".join(traceback.format_exception(error)))
        return response

    server.run_in_threadpool = _call_directly  # type: ignore[assignment]
    endpoints._unexpected_error_response = record_error
    try:
        yield server.make_application(app_state, fixed_credentials())
    finally:
        server.run_in_threadpool, endpoints._unexpected_error_response = (
            run_in_threadpool,
            make_error_response,
        )
