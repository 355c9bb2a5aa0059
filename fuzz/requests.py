"""Requests to the application (`counterspin serve`), as no page of its own would send them.

A case is some requests in a row, as JSON. They begin as valid ones of each kind; method, path,
words, headers, form, pieces and end are then changed. They are asked of a folder that holds what
nobody expects in one: links that lead out, pipes, names that are no text.

- `application`: the format; `VALID`: a valid request of each kind
- `InlineAppState`, `send_request`: sending of requests
- `check_answer`: checks of an answer
- `WatchedFolder`: checks that no file outside is accessed, and none is lost
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import shutil
import threading
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import quote, urlencode

import signing_keys
from cryptography.hazmat.primitives.asymmetric import ec
from served import ANSWERS, write_folder

import certificates
from counterspin.application import server
from counterspin.application.access_control import FILES_PATH, SESSION_PATH, TICKET_PATH
from counterspin.application.campaign_files import TRASH_FOLDER
from counterspin.application.endpoints import ENDPOINTS
from counterspin.application.served_folder import ServedFolder
from counterspin.calibration.calibrate import calibrate
from counterspin.certificates.lab import write_example as write_lab
from counterspin.ingest.starter import init
from counterspin.studies.study import study
from fuzz.asking import (
    HOST,
    KEY,
    PORT,
    SECRET,
    TOKEN,
    InlineAppState,
    RequestRefusedError,
    WatchedFolder,
    check_answer,
    send_request,
    unthreaded_application,
)
from fuzz.format import Format
from fuzz.mutations import HOSTILE, mutate_bytes, mutate_text, mutate_tree

#: Names that lead out, are none, or are those of what is there.
NAMES: tuple[str, ...] = (
    *("", ".", "..", "../outside", "../outside/secret.toml", "three/../../outside/secret.toml"),
    *("/etc/passwd", "//etc/passwd", "/dev/stdout", "/dev/full", "C:\\x", "..\\x", "~", "~root/x"),
    *(
        "a\0b",
        "\0",
        "a\nb",
        "\ud800",
        "\udcff.json",
        "x\udcff",
        "ä ö/ü.csv",
        "\u202exml.exe",
        "e\u0301",
    ),
    *(
        "a" * 255,
        "a" * 256 + ".json",
        "a/" * 2000,
        "/".join("a" * 200 for _ in range(40)),
        "a" * 70000,
    ),
    *("con", "nul.csv", "a.", "a ", " a", "-rf", "--json", "$(id)", "`id`.csv", "%2e%2e/x", "%00"),
    *("away", "away/secret.toml", "away.toml", "away.json", "away.csv", "round", "round/x"),
    *(
        "pipe.toml",
        "pipe.json",
        "pipe.csv",
        "pipe.xml",
        "pipe",
        "three",
        "three/",
        "three//slow.csv",
    ),
    *(
        "three/campaign.toml",
        "three/result.json",
        "three/slow.csv",
        "three/slow.csv/x",
        "PLAN.toml",
    ),
    *(
        "LAB.toml",
        "exports",
        "exports/a.csv",
        "tumble",
        "tumble/campaign.toml",
        "new",
        "new/result.json",
    ),
    *(
        "three/two-stage.json",
        "three/.hidden.json",
        ".git/config",
        "new/new/new",
        "broken",
        "broken.json",
    ),
    *(
        "three/result.json\nthree/two-stage.json",
        "\n",
        "three/result.json\n" * 50,
        "odd",
        "odd/campaign.toml",
        "odd/LAB.toml",
        "linked",
    ),
    *(
        "three/certificate.pdf",
        "new.xml",
        "three/new.json",
        "new.h5",
        "new/x.tdms",
        "new.xlsx",
        "new.mat",
    ),
)

_FORM = "application/json"
_CURVE = ec.SECP256R1()

#: Stands in a request for a ticket, which is issued when it is asked.
TICKET = "TICKET"


def valid_requests(folder: Path) -> dict[str, tuple[str, str, Any]]:
    """Return a valid request of each kind: method, path, and what it says."""
    texts = {
        name: (folder / name).read_text(encoding="utf-8")
        for name in ("three/campaign.toml", "tumble/campaign.toml", "LAB.toml", "PLAN.toml")
    }
    campaign, tumble, lab, _ = texts.values()
    versions = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    result = "three/result.json"
    both = f"{result}\nthree/two-stage.json"
    own, labs = {"file": "three/campaign.toml", "text": campaign}, {"file": "LAB.toml", "text": lab}
    run = {"name": "three", "run": "slow"}
    files = ["exports/slow.csv", "exports/fast.csv"]
    rate = ["runs", 0, "rate"]
    signer = (folder / "signer.pem").read_bytes()
    key = {"name": "signer.pem", "content": b64encode(signer).decode()}
    asked: dict[str, tuple[str, str, Any]] = {
        "session": ("POST", SESSION_PATH, {"token": TOKEN}),
        "ticket": ("GET", f"{TICKET_PATH}{TICKET}", {}),
        "files": (
            "POST",
            f"{FILES_PATH}?{urlencode({'name': 'new/slow.csv'})}",
            b"time_s,angle\n0,0\n1,2\n",
        ),
        "page itself": ("GET", "/", {}),
        "asset": ("GET", "/assets/main.js", {}),
        "style": ("GET", "/assets/report.css", {}),
    }
    said: dict[str, list[Any]] = {
        "GET folder": [{}],
        "GET campaign": [{"name": "three"}, {"name": "tumble"}],
        "POST copy": [{"name": "three", "to": "copied"}],
        "POST rename": [{"name": "three", "to": "new/three"}],
        "POST put-away": [{"name": "three"}],
        "POST restore": [{"place": "20260101T000000000000-old"}],
        "POST sample": [{}],
        "POST records": [{"name": "three", "files": files[:1]}],
        "POST campaign": [{"name": "new", "test": "tumble"}, {"name": "new"}],
        "GET manual": [{"name": "campaign"}],
        "GET description": [{"name": "three"}, {"name": "tumble"}],
        "GET lab": [{"file": "LAB.toml", "result": result}, {"file": "new.toml", "result": result}],
        "GET plan-text": [{"name": "PLAN.toml"}],
        "POST check": [
            own,
            labs | {"result": result},
            {"file": "tumble/campaign.toml", "text": tumble},
        ],
        "POST change": [
            own | {"path": ["centrifuge", "radius"], "value": "3 m"},
            own | {"path": rate, "value": "1.5 rev/s"},
            own
            | {"path": ["runs", 3], "value": {"name": "x", "rate": "1 rev/s", "record": "x.csv"}},
            own | {"path": ["accelerometers", "Qx", "bias"], "value": None},
            own | {"path": ["model", "priors", "K_O"], "value": "1 g/g"},
            labs
            | {
                "path": ["certificate", "issue_date"],
                "value": "2026-03-01",
                "kind": "date",
                "result": result,
            },
        ],
        "PUT text": [
            own | {"text": campaign + "\n# mine\n", "version": versions["three/campaign.toml"]},
            labs | {"text": lab + "#\n", "version": versions["LAB.toml"], "result": result},
            labs | {"file": "new/LAB.toml", "version": "", "result": result},
        ],
        "GET page": [
            {"kind": "result", "names": result},
            {"kind": "comparison", "names": both},
            {"kind": "history", "names": both, "term": "K_II"},
            {"kind": "forecast", "names": "three/campaign.toml"},
            {"kind": "study", "names": "three/study.json"},
        ],
        "GET picture": [
            {"kind": "result", "names": result, "place": "0"},
            {"kind": "history", "names": both, "term": "K_I", "place": "0"},
        ],
        "POST what-if": [
            {"name": result, "accelerometer": "Qx"},
            {"name": result, "accelerometer": "Qx", "known": {"K_III": 1e-7}},
        ],
        "GET ways": [{"name": "three", "result": result}],
        "POST ways": [{"name": "three"}],
        "POST way": [
            {"name": "three", "result": result, "accelerometer": "Qx", "way": "state"},
        ],
        "POST fit": [{"name": "three"}],
        "GET record-about": [run, run | {"fit": "true"}],
        "GET record": [
            run | {"low": "0", "high": "5"},
            run | {"low": "1", "high": "2", "parts": "3"},
        ],
        "GET check": [run],
        "GET watch": [{"name": "three"}, {"name": "three", "goal": "K_II 1e-8 g/g^2"}],
        "POST draft": [{"names": files}],
        "POST discard": [{"folder": "new", "names": files[:1]}],
        "POST drafted": [{"folder": "new", "names": files, "answers": ANSWERS}],
        "POST certificate": [
            {"result": result, "lab": "LAB.toml", "output": "three/certificate.xml"},
            {"result": result, "lab": "LAB.toml", "output": "new.pdf", "both": True},
            {"result": result, "lab": "LAB.toml", "output": "new.xml", "signing": {"key": key}},
            {"result": result, "lab": "own.toml", "output": "new.xml", "signing": {"key": key}},
            {"result": result, "lab": "odd/LAB.toml", "output": "new.xml"},
        ],
        "POST certificate-preview": [
            labs | {"result": result},
            labs | {"result": result, "text": "[certificate]\n"},
        ],
        "POST certificate-check": [
            {"name": "three/certificate.pdf"},
            {"name": "three/certificate.pdf", "certificate": key},
        ],
        "POST profile": [{"file": "LAB.toml", "text": lab.replace("Example Calibration", "Bench")}],
        "GET file": [{"name": result}, {"name": "PLAN.toml"}],
        "POST ticket": [
            {"name": "file", "parameters": {"name": result}},
            {"name": "report", "parameters": {"name": result, "kind": "md"}},
        ],
        "GET plan": [{"name": "PLAN.toml"}],
        "POST plan": [{"name": "new.toml"}, {"name": "poses.toml", "example": "poses"}],
        "POST plan-page": [{"name": "PLAN.toml", "moved": {"total_time": 2000.0, "runs": 3}}],
        "POST planned": [{"name": "PLAN.toml", "moved": {"highest_rate": 5.0}, "folder": "new"}],
        "GET jobs": [{}],
        "POST jobs": [
            {"name": "three"},
            {"name": "three", "output": "new.json", "method": "two-stage"},
        ],
        "GET report": [{"name": result, "kind": "md"}],
        "POST study": [{"name": "three", "trials": 4}],
        "POST study-duration": [{"name": "three"}],
        "POST simulation": [{"name": "three", "folder": "new"}],
        "DELETE jobs": [{"number": 1}],
    }
    for key, some in said.items():
        method, _, name = key.partition(" ")
        for place, words in enumerate(some):
            asked[f"{key} {place}"] = (method, f"/api/{name}", words)
    return asked


# Requests, valid and changed


def request_of(method: str, path: str, said: Any) -> dict[str, Any]:
    """Return a request as the page sends it."""
    body = b""
    if method == "GET" and said:
        path = f"{path}?{urlencode(said)}"
    elif method != "GET":
        body = said if isinstance(said, bytes) else json.dumps(said).encode()
    headers = [["host", HOST], ["authorization", f"Bearer {KEY}"]]
    if method != "GET":
        kind = "application/octet-stream" if isinstance(said, bytes) else _FORM
        headers += [["origin", f"http://{HOST}"], ["content-type", kind]]
        headers += [["content-length", str(len(body))]]
    return {
        "method": method,
        "target": path,
        "headers": headers,
        "body": body.decode("latin-1"),
        "pieces": 1,
        "gone": False,
        "stranger": "",
    }


def _changed(rng: Random, valid: tuple[str, str, Any], others: list[Any]) -> dict[str, Any]:
    """Return a request that is changed in one way or another, or as it is."""
    method, path, said = valid
    kind = rng.random()
    if kind < 0.45 and isinstance(said, dict):
        said = _other_words(rng, said, others)
    request = request_of(method, path, _texts(said) if method == "GET" else said)
    if 0.45 <= kind < 0.6:
        _change_bytes(rng, request)
    elif 0.6 <= kind < 0.75:
        _change_headers(rng, request)
    elif 0.75 <= kind < 0.85:
        _change_target(rng, request)
    elif 0.85 <= kind < 0.92:
        request["pieces"] = rng.choice((2, 7, 40))
        request["gone"] = rng.random() < 0.7
    return request


def _other_words(rng: Random, said: dict[str, Any], others: list[Any]) -> Any:
    """Return a form with other names, texts and values."""
    kind = rng.randrange(4)
    if kind < 2:
        said = dict(said)
        key = rng.choice(sorted(said) or ["name"])
        value = said.get(key)
        if isinstance(value, str) and len(value) > 300:
            said[key] = mutate_text(rng, value)
        elif isinstance(value, list):
            said[key] = [rng.choice(NAMES) if rng.random() < 0.5 else one for one in value]
        else:
            said[key] = rng.choice(NAMES if rng.random() < 0.7 else HOSTILE)
        return said
    if kind == 2:
        return mutate_tree(rng, said, others)
    return mutate_tree(rng, mutate_tree(rng, said, others), others)


def _texts(said: Any) -> dict[str, str]:
    """Return the words of a query."""
    some = said if isinstance(said, dict) else {"name": said}
    return {_sent(str(key)): _sent(str(value)) for key, value in some.items()}


def _sent(text: str) -> str:
    """Return a text that can be encoded; what is none stays as its bytes."""
    return text.encode("utf-8", "surrogatepass").decode("latin-1") if "\ud800" in text else text


def _change_bytes(rng: Random, request: dict[str, Any]) -> None:
    if request["body"]:
        body = mutate_bytes(rng, request["body"].encode("latin-1"))
        request["body"] = body.decode("latin-1")
        if rng.random() < 0.7:
            _set(request, "content-length", str(len(body)))
    else:
        target = mutate_bytes(rng, request["target"].encode()).decode("latin-1")
        request["target"] = "/" + target.lstrip("/")


_PATHS = (
    *(
        "/api/",
        "/api",
        "/api/nothing",
        "/api/folder/",
        "/api/../",
        "/assets/",
        "/assets/../server.py",
    ),
    *("/assets/%2e%2e/server.py", "/assets/..%2fserver.py", "/assets/main.js/", "/assets/\0.js"),
    *("/assets/%00.js", "/assets/%ff.js", "/assets/a%2f..%2fmain.js", "//", "/.", "/%2e%2e/"),
    *("/assets/" + "a" * 5000 + ".js", "/api/" + "a" * 5000, "/api/%ed%a0%80", "*", "/assets/.js"),
    *(
        "http://example.org/api/folder",
        "/index.html",
        "/favicon.ico",
        "/assets/index.html",
        "/#/plans",
    ),
)

_METHODS = (
    "GET",
    "HEAD",
    "POST",
    "PUT",
    "DELETE",
    "PATCH",
    "OPTIONS",
    "TRACE",
    "CONNECT",
    "get",
    "X\u00e4",
)


def _change_target(rng: Random, request: dict[str, Any]) -> None:
    kind = rng.randrange(4)
    if kind == 0:
        request["method"] = rng.choice(_METHODS)
    elif kind == 1:
        request["target"] = rng.choice(_PATHS)
    elif kind == 2:
        path, _, query = request["target"].partition("?")
        name = quote(rng.choice(NAMES).encode("utf-8", "surrogatepass"))
        request["target"] = rng.choice(
            (
                f"{path}?name={name}",
                f"{path}/{name}",
                f"{path}?{query}&{query}",
                f"{path}?{query}&x=1",
                f"{path}?{query}&name={name}",
                f"/assets/{name}",
                f"{path}?name=%ff%fe&names=%0a&run=%00",
            )
        )
    else:
        request["method"] = rng.choice(_METHODS)
        request["target"] = "/api/" + rng.choice(sorted(ENDPOINTS))[1]


#: Headers that tell of a stranger: none of these may get anything of the folder.
_STRANGERS: tuple[tuple[str, str | None], ...] = (
    *(
        ("host", host)
        for host in ("example.org", f"example.org:{PORT}", "127.0.0.1", "", "[::]:8765")
    ),
    *(
        ("host", host)
        for host in (f"{HOST}.example.org", f"{HOST}@example.org", "127.0.0.1:1", None)
    ),
    *(("host", host) for host in (f" {HOST}x", "127.0.0.1:08765", "0.0.0.0:8765", "\xe4:8765")),
    *(
        ("origin", origin)
        for origin in ("http://example.org", "null", "", f"https://{HOST}", "\xff")
    ),
    *(
        ("origin", origin)
        for origin in (f"http://{HOST}.example.org", "http://localhost:8765", "file://")
    ),
    *(
        ("authorization", said)
        for said in (None, "", KEY, "Bearer", "Bearer ", f"Bearer {TOKEN}", f"Bearer {TICKET}")
    ),
    *(
        ("authorization", said)
        for said in (f"Bearer {KEY}x", f"Bearer  {KEY}", f"Bearer {KEY[1:]}", f"Basic {KEY}")
    ),
    *(("authorization", said) for said in ("Bearer \xe4", "\xff", ";" * 5000, "Bearer\t" + KEY)),
    *(("sec-fetch-site", site) for site in ("cross-site", "same-site", "none of these")),
)

_HEADERS = (
    *(
        ("content-length", length)
        for length in ("-1", "0", "1", "99999999999", "1e3", "", "\xb2", "x" * 9)
    ),
    *(
        ("content-type", kind)
        for kind in ("", "text/html", "multipart/form-data", "application/json; charset=x")
    ),
    *(
        ("accept-encoding", "gzip"),
        ("range", "bytes=0-5"),
        ("if-none-match", "*"),
        ("expect", "100-continue"),
    ),
    *(("transfer-encoding", "chunked"), ("x" * 300, "y" * 9000), ("cookie", 'a=b; c="d"; ' * 20)),
    *(
        ("host", "LOCALHOST:8765"),
        ("x-forwarded-for", "10.0.0.1"),
        ("forwarded", "host=x"),
        ("upgrade", "websocket"),
    ),
)


def _change_headers(rng: Random, request: dict[str, Any]) -> None:
    if rng.random() < 0.6:
        name, value = rng.choice(_STRANGERS)
        request["stranger"] = name
    else:
        name, value = rng.choice(_HEADERS)
    if value is None:
        request["headers"] = [one for one in request["headers"] if one[0] != name]
    elif rng.random() < 0.8:
        _set(request, name, value)
    else:
        request["headers"].append([name, value])


def _set(request: dict[str, Any], name: str, value: str) -> None:
    request["headers"] = [one for one in request["headers"] if one[0] != name] + [[name, value]]


# The format


def write_odd(folder: Path) -> None:
    """Add to a folder what nobody expects: links that lead out, pipes, names that are no text."""
    outside = folder.parent / "outside"
    outside.mkdir(exist_ok=True)
    for name in ("secret.toml", "secret.json", "secret.csv"):
        (outside / name).write_text(f'{SECRET} = "{SECRET}"\n', encoding="utf-8")
    (folder / "away").symlink_to(outside)
    for suffix in ("toml", "json", "csv"):
        (folder / f"away.{suffix}").symlink_to(outside / f"secret.{suffix}")
        os.mkfifo(folder / f"pipe.{suffix}")
    os.mkfifo(folder / "pipe.xml")
    (folder / "round").symlink_to("round")
    (folder / "broken").mkdir()
    (folder / "broken" / "campaign.toml").write_text("schema = ", encoding="utf-8")
    (folder / "broken.json").write_bytes(b'{"schema": 1, "counterspin": "\xff')
    for name in (b"\xff.json", b"\xff.toml", b"\xff.csv"):
        with open(os.path.join(os.fsencode(folder), name), "w") as file:  # noqa: PTH118, PTH123
            file.write("x = 1\n")
    odd = folder / "odd"
    odd.mkdir()
    text = (folder / "three" / "campaign.toml").read_text(encoding="utf-8")
    text = text.replace('record = "slow.csv"', 'record = "../../outside/secret.csv"')
    (odd / "campaign.toml").write_text(text, encoding="utf-8")
    (odd / "sub").symlink_to(outside)
    lab = (folder / "LAB.toml").read_text(encoding="utf-8")
    lab = lab.replace("[certificate]\n", '[certificate]\nledger = "sub/ledger.jsonl"\n')
    (odd / "LAB.toml").write_text(lab, encoding="utf-8")
    (folder / "linked").mkdir()
    (folder / "linked" / "campaign.toml").symlink_to(outside / "campaign.toml")


#: What takes more than 50 ms is asked a tenth as often.
_DEAR = (
    "GET page",
    "GET picture",
    "GET check",
    "POST cert",
    "POST plan-",
    "POST planned",
    "POST jobs",
    "POST study",
    "POST sim",
    "GET report",
)


def case(rng: Random, valid: dict[str, tuple[str, str, Any]], others: list[Any]) -> bytes:
    """Return some requests in a row, as JSON."""
    count = rng.choice((1, 1, 1, 2, 3))
    weights = [0.1 if name.startswith(_DEAR) else 1.0 for name in valid]
    chosen = rng.choices(list(valid.values()), weights, k=count)
    return json.dumps([_changed(rng, one, others) for one in chosen]).encode()


def write_served(folder: Path) -> None:
    """Write a folder with something of each kind: campaigns, results, records, plan, laboratory."""
    write_folder(folder, folder.parent / "plan")
    calibrate(folder / "three", method="two-stage").write(folder / "three" / "two-stage.json")
    study(folder / "three", trials=4).write(folder / "three" / "study.json")
    (folder / "exports").mkdir()
    for name in ("slow.csv", "fast.csv"):
        shutil.copy(folder / "three" / name, folder / "exports" / name)
    init(folder / "tumble", "tumble")
    init(folder / TRASH_FOLDER / "20260101T000000000000-old", "tumble")
    write_lab(folder / "LAB.toml")
    certificates.write_filled_template(folder / "own.toml")
    key, cert = signing_keys.write_pair(folder.parent / "k", ec.derive_private_key(1, _CURVE))
    (folder / "signer.pem").write_bytes(key.read_bytes() + cert.read_bytes())
    text = (files("counterspin.planning") / "starter.toml").read_text("utf-8")
    (folder / "PLAN.toml").write_text(text.replace("runs = 14", "runs = 2"), encoding="utf-8")
    write_odd(folder)


def prepared(place: Path) -> tuple[Path, WatchedFolder]:
    """Return a folder as each case finds it, and the one that is served, below a place."""
    template = place / "template"
    template.mkdir()
    write_served(template)
    (place / "served").mkdir()
    shutil.copytree(place / "outside", place / "served" / "outside")
    return template, WatchedFolder(place / "served" / "folder", template)


def with_ticket(app_state: InlineAppState, sent: str) -> str:
    """Return what is sent, with a ticket that counts where one is to stand."""
    if TICKET not in sent:
        return sent
    return sent.replace(TICKET, app_state.tickets.issue(("file", {"name": "three/result.json"})))


def application(place: Path) -> Format:
    """Return requests to the application."""
    template, watched = prepared(place)
    valid = valid_requests(template)
    others = [said for _, _, said in valid.values() if isinstance(said, dict) and said]
    app_state = InlineAppState(ServedFolder(watched.folder))
    server._preload_modules(app_state, threading.Event())

    def use(path: Path) -> None:
        requests = json.loads(path.read_bytes())
        try:
            asyncio.run(_all(app_state, watched, requests))
        finally:
            watched.restore()

    return Format(".json", lambda rng: case(rng, valid, others), use)


async def _all(
    app_state: InlineAppState, watched: WatchedFolder, requests: list[dict[str, Any]]
) -> None:
    """Ask all requests of a case; raise what is found, or that the last one was refused."""
    raised: list[str] = []
    entered = 0
    before = watched.first
    with unthreaded_application(app_state, raised) as app:
        for number, said in enumerate(requests):
            request = said | {"target": with_ticket(app_state, said["target"])}
            with watched.looking():
                answered = await send_request(app, request)
                if request["target"].startswith(TICKET_PATH) and answered.status == 200:
                    again = await send_request(app, request)
                    assert again.status == 404, "a ticket counted twice"
            entered += request["target"].startswith(SESSION_PATH) and answered.status == 200
            assert entered <= 1, "a link counted twice"
            before = watched.require_whole(request, answered.status, before)
            try:
                check_answer(request, answered, "\n".join(raised))
            except RequestRefusedError:
                if number == len(requests) - 1:
                    raise
