"""Malformed and hostile requests to the application (`counterspin serve`).

A case is a sequence of requests, as JSON. Each is a valid request with mutated method, path,
parameters, headers, content type, chunks or end. The served folder contains hostile entries: links
to the outside, pipes, and names that are not valid text.

- `requests_format`: the format; `valid_requests`: valid requests to every endpoint
- `make_request`: make a request as the page sends it
- `prepare_folders`: write the served folder and its template
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
from fuzz.application_client import (
    HOST,
    KEY,
    PORT,
    SECRET,
    TOKEN,
    InlineAppState,
    RequestRefusedError,
    WatchedFolder,
    check_response,
    send_request,
    unthreaded_application,
)
from fuzz.format import Format
from fuzz.mutations import HOSTILE_VALUES, mutate_bytes, mutate_text, mutate_tree

#: File names: outside the folder, invalid, or existing.
HOSTILE_NAMES: tuple[str, ...] = (
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

_JSON_TYPE = "application/json"
_CURVE = ec.SECP256R1()

#: Placeholder in a request for a ticket, which is issued when the request is sent.
TICKET = "TICKET"


def valid_requests(folder: Path) -> dict[str, tuple[str, str, Any]]:
    """Return name -> method, path and parameters or body, for requests to every endpoint."""
    texts = {
        name: (folder / name).read_text(encoding="utf-8")
        for name in ("three/campaign.toml", "tumble/campaign.toml", "LAB.toml", "PLAN.toml")
    }
    campaign, tumble, lab, _ = texts.values()
    versions = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    result = "three/result.json"
    result_names = f"{result}\nthree/two-stage.json"
    campaign_file, lab_file = (
        {"file": "three/campaign.toml", "text": campaign},
        {"file": "LAB.toml", "text": lab},
    )
    run = {"name": "three", "run": "slow"}
    files = ["exports/slow.csv", "exports/fast.csv"]
    rate_path = ["runs", 0, "rate"]
    signer = (folder / "signer.pem").read_bytes()
    key = {"name": "signer.pem", "content": b64encode(signer).decode()}
    requests: dict[str, tuple[str, str, Any]] = {
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
    parameters_by_endpoint: dict[str, list[Any]] = {
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
            campaign_file,
            lab_file | {"result": result},
            {"file": "tumble/campaign.toml", "text": tumble},
        ],
        "POST change": [
            campaign_file | {"path": ["centrifuge", "radius"], "value": "3 m"},
            campaign_file | {"path": rate_path, "value": "1.5 rev/s"},
            campaign_file
            | {"path": ["runs", 3], "value": {"name": "x", "rate": "1 rev/s", "record": "x.csv"}},
            campaign_file | {"path": ["accelerometers", "Qx", "bias"], "value": None},
            campaign_file | {"path": ["model", "priors", "K_O"], "value": "1 g/g"},
            lab_file
            | {
                "path": ["certificate", "issue_date"],
                "value": "2026-03-01",
                "kind": "date",
                "result": result,
            },
        ],
        "PUT text": [
            campaign_file
            | {"text": campaign + "\n# mine\n", "version": versions["three/campaign.toml"]},
            lab_file | {"text": lab + "#\n", "version": versions["LAB.toml"], "result": result},
            lab_file | {"file": "new/LAB.toml", "version": "", "result": result},
        ],
        "GET page": [
            {"kind": "result", "names": result},
            {"kind": "comparison", "names": result_names},
            {"kind": "history", "names": result_names, "term": "K_II"},
            {"kind": "forecast", "names": "three/campaign.toml"},
            {"kind": "study", "names": "three/study.json"},
        ],
        "GET picture": [
            {"kind": "result", "names": result, "place": "0"},
            {"kind": "history", "names": result_names, "term": "K_I", "place": "0"},
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
            lab_file | {"result": result},
            lab_file | {"result": result, "text": "[certificate]\n"},
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
    for key, parameter_sets in parameters_by_endpoint.items():
        method, _, name = key.partition(" ")
        for index, parameters in enumerate(parameter_sets):
            requests[f"{key} {index}"] = (method, f"/api/{name}", parameters)
    return requests


# Valid and mutated requests


def make_request(method: str, path: str, parameters: Any) -> dict[str, Any]:
    """Return a request as the page sends it."""
    body = b""
    if method == "GET" and parameters:
        path = f"{path}?{urlencode(parameters)}"
    elif method != "GET":
        body = parameters if isinstance(parameters, bytes) else json.dumps(parameters).encode()
    headers = [["host", HOST], ["authorization", f"Bearer {KEY}"]]
    if method != "GET":
        content_type = "application/octet-stream" if isinstance(parameters, bytes) else _JSON_TYPE
        headers += [["origin", f"http://{HOST}"], ["content-type", content_type]]
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


def _mutate_request(rng: Random, valid: tuple[str, str, Any], donors: list[Any]) -> dict[str, Any]:
    """Return a request, possibly mutated."""
    method, path, parameters = valid
    choice = rng.random()
    if choice < 0.45 and isinstance(parameters, dict):
        parameters = _mutate_parameters(rng, parameters, donors)
    request = make_request(
        method, path, _query_texts(parameters) if method == "GET" else parameters
    )
    if 0.45 <= choice < 0.6:
        _mutate_body(rng, request)
    elif 0.6 <= choice < 0.75:
        _mutate_headers(rng, request)
    elif 0.75 <= choice < 0.85:
        _mutate_target(rng, request)
    elif 0.85 <= choice < 0.92:
        request["pieces"] = rng.choice((2, 7, 40))
        request["gone"] = rng.random() < 0.7
    return request


def _mutate_parameters(rng: Random, parameters: dict[str, Any], donors: list[Any]) -> Any:
    """Return parameters with other names, texts and values."""
    mutation = rng.randrange(4)
    if mutation < 2:
        parameters = dict(parameters)
        key = rng.choice(sorted(parameters) or ["name"])
        value = parameters.get(key)
        if isinstance(value, str) and len(value) > 300:
            parameters[key] = mutate_text(rng, value)
        elif isinstance(value, list):
            parameters[key] = [
                rng.choice(HOSTILE_NAMES) if rng.random() < 0.5 else name for name in value
            ]
        else:
            parameters[key] = rng.choice(HOSTILE_NAMES if rng.random() < 0.7 else HOSTILE_VALUES)
        return parameters
    if mutation == 2:
        return mutate_tree(rng, parameters, donors)
    return mutate_tree(rng, mutate_tree(rng, parameters, donors), donors)


def _query_texts(parameters: Any) -> dict[str, str]:
    """Return the parameters of a query as text."""
    named_parameters = parameters if isinstance(parameters, dict) else {"name": parameters}
    return {
        _to_encodable(str(key)): _to_encodable(str(value))
        for key, value in named_parameters.items()
    }


def _to_encodable(text: str) -> str:
    """Return a text that can be encoded; surrogates become their bytes in Latin-1."""
    return text.encode("utf-8", "surrogatepass").decode("latin-1") if "\ud800" in text else text


def _mutate_body(rng: Random, request: dict[str, Any]) -> None:
    if request["body"]:
        body = mutate_bytes(rng, request["body"].encode("latin-1"))
        request["body"] = body.decode("latin-1")
        if rng.random() < 0.7:
            _set_header(request, "content-length", str(len(body)))
    else:
        target = mutate_bytes(rng, request["target"].encode()).decode("latin-1")
        request["target"] = "/" + target.lstrip("/")


_HOSTILE_PATHS = (
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


def _mutate_target(rng: Random, request: dict[str, Any]) -> None:
    mutation = rng.randrange(4)
    if mutation == 0:
        request["method"] = rng.choice(_METHODS)
    elif mutation == 1:
        request["target"] = rng.choice(_HOSTILE_PATHS)
    elif mutation == 2:
        path, _, query = request["target"].partition("?")
        name = quote(rng.choice(HOSTILE_NAMES).encode("utf-8", "surrogatepass"))
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


#: Headers of unauthorised requests, which must not return any content of the folder.
_UNAUTHORISED_HEADERS: tuple[tuple[str, str | None], ...] = (
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

_HOSTILE_HEADERS = (
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


def _mutate_headers(rng: Random, request: dict[str, Any]) -> None:
    if rng.random() < 0.6:
        name, value = rng.choice(_UNAUTHORISED_HEADERS)
        request["stranger"] = name
    else:
        name, value = rng.choice(_HOSTILE_HEADERS)
    if value is None:
        request["headers"] = [header for header in request["headers"] if header[0] != name]
    elif rng.random() < 0.8:
        _set_header(request, name, value)
    else:
        request["headers"].append([name, value])


def _set_header(request: dict[str, Any], name: str, value: str) -> None:
    request["headers"] = [header for header in request["headers"] if header[0] != name] + [
        [name, value]
    ]


# The format


def write_hostile_files(folder: Path) -> None:
    """Add hostile entries to a folder: links to the outside, pipes, names that are not text."""
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
    hostile_folder = folder / "odd"
    hostile_folder.mkdir()
    text = (folder / "three" / "campaign.toml").read_text(encoding="utf-8")
    text = text.replace('record = "slow.csv"', 'record = "../../outside/secret.csv"')
    (hostile_folder / "campaign.toml").write_text(text, encoding="utf-8")
    (hostile_folder / "sub").symlink_to(outside)
    lab = (folder / "LAB.toml").read_text(encoding="utf-8")
    lab = lab.replace("[certificate]\n", '[certificate]\nledger = "sub/ledger.jsonl"\n')
    (hostile_folder / "LAB.toml").write_text(lab, encoding="utf-8")
    (folder / "linked").mkdir()
    (folder / "linked" / "campaign.toml").symlink_to(outside / "campaign.toml")


#: Requests that take more than 50 ms, which are drawn ten times less often.
_SLOW_REQUESTS = (
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


def draw_case(rng: Random, valid: dict[str, tuple[str, str, Any]], donors: list[Any]) -> bytes:
    """Return a sequence of requests as JSON."""
    n_requests = rng.choice((1, 1, 1, 2, 3))
    weights = [0.1 if name.startswith(_SLOW_REQUESTS) else 1.0 for name in valid]
    selected = rng.choices(list(valid.values()), weights, k=n_requests)
    return json.dumps([_mutate_request(rng, request, donors) for request in selected]).encode()


def write_served_folder(folder: Path) -> None:
    """Write a folder with campaigns, results, records, a plan and a laboratory file."""
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
    write_hostile_files(folder)


def prepare_folders(parent: Path) -> tuple[Path, WatchedFolder]:
    """Write the template of the served folder, and the served folder, below `parent`."""
    template = parent / "template"
    template.mkdir()
    write_served_folder(template)
    (parent / "served").mkdir()
    shutil.copytree(parent / "outside", parent / "served" / "outside")
    return template, WatchedFolder(parent / "served" / "folder", template)


def insert_ticket(app_state: InlineAppState, text: str) -> str:
    """Return the text of a request with its placeholder replaced by a valid ticket."""
    if TICKET not in text:
        return text
    return text.replace(TICKET, app_state.tickets.issue(("file", {"name": "three/result.json"})))


def requests_format(parent: Path) -> Format:
    """Return the format of requests to the application."""
    template, watched = prepare_folders(parent)
    valid = valid_requests(template)
    donors = [
        parameters
        for _, _, parameters in valid.values()
        if isinstance(parameters, dict) and parameters
    ]
    app_state = InlineAppState(ServedFolder(watched.folder))
    server._preload_modules(app_state, threading.Event())

    def read(path: Path) -> None:
        requests = json.loads(path.read_bytes())
        try:
            asyncio.run(_send_requests(app_state, watched, requests))
        finally:
            watched.restore()

    return Format(".json", lambda rng: draw_case(rng, valid, donors), read)


async def _send_requests(
    app_state: InlineAppState, watched: WatchedFolder, requests: list[dict[str, Any]]
) -> None:
    """Send the requests of a case; raise AssertionError for a finding, or RequestRefusedError.

    Only the refusal of the last request is raised.
    """
    tracebacks: list[str] = []
    n_sessions = 0
    before = watched.initial_state
    with unthreaded_application(app_state, tracebacks) as app:
        for index, case_request in enumerate(requests):
            request = case_request | {"target": insert_ticket(app_state, case_request["target"])}
            with watched.forbid_outside_access():
                response = await send_request(app, request)
                if request["target"].startswith(TICKET_PATH) and response.status == 200:
                    second_response = await send_request(app, request)
                    assert second_response.status == 404, "a ticket was accepted twice"
            n_sessions += request["target"].startswith(SESSION_PATH) and response.status == 200
            assert n_sessions <= 1, "a session link was accepted twice"
            before = watched.check_changes(request, response.status, before)
            try:
                check_response(request, response, "\n".join(tracebacks))
            except RequestRefusedError:
                if index == len(requests) - 1:
                    raise
