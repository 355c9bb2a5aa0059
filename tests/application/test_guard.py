"""Who may ask: nobody but the page itself, by its own address, with the key."""

import pytest

from counterspin.application import guard
from counterspin.application.guard import Door

FOLDER = "/api/folder"


def test_the_page_itself_is_answered(page):
    assert page.get(FOLDER).status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "example.org",
        "example.org:8765",
        "127.0.0.1:1234",
        "127.0.0.1",
        "127.0.0.1.example.org:8765",
    ],
)
@pytest.mark.parametrize("path", ["/", "/assets/main.js", "/api/session", FOLDER])
def test_a_foreign_host_is_refused(page, path, host):
    """A name that was made to lead here, DNS rebinding, is told in Host; no Origin tells it."""
    del page.headers["Origin"]
    assert page.get(path, headers={"Host": host}).status_code == 403


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "localhost:8765", "LOCALHOST:8765"])
def test_this_machine_s_own_names_are_taken(page, host):
    headers = {"Host": host, "Origin": f"http://{host.lower()}"}
    assert page.get("/", headers=headers).status_code == 200


@pytest.mark.parametrize(
    "origin",
    [
        "http://example.org",
        "null",
        "http://127.0.0.1:1234",
        "https://127.0.0.1:8765",
        "http://localhost:8765",
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_foreign_origin_is_refused(page, method, origin):
    assert page.request(method, FOLDER, headers={"Origin": origin}).status_code == 403


def test_what_changes_something_says_its_origin(page):
    del page.headers["Origin"]
    assert page.get(FOLDER).status_code == 200
    assert page.post("/api/jobs", json={"name": "three"}).status_code == 403
    assert page.get("/api/jobs").json() == []


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_what_another_page_embeds_is_refused(page, site):
    assert page.get(FOLDER, headers={"Sec-Fetch-Site": site}).status_code == 403


def test_without_the_key_nothing_of_the_folder_is_told(stranger, door):
    assert stranger.get("/").status_code == 200
    assert stranger.get(FOLDER).status_code == 401
    assert stranger.post("/api/session", json={"token": "x" * 32}).status_code == 403
    for odd in ("", "[]", '{"token": null}', '{"token": "\u00e4"}', "[" * 9999):
        assert stranger.post("/api/session", content=odd.encode()).status_code == 403
    assert stranger.get(FOLDER).status_code == 401
    stranger.cookies.set(door.cookie, door.token)
    assert stranger.get(FOLDER).status_code == 401
    stranger.cookies.clear()
    other = Door(1234)
    stranger.cookies.set(door.cookie, other.pass_word)
    assert stranger.get(FOLDER).status_code == 401


def test_the_cookie_is_for_this_page_alone(stranger, door):
    cookie = stranger.post("/api/session", json={"token": door.token}).headers["set-cookie"]
    assert cookie.startswith(f"counterspin-8765={door.pass_word};")
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))


def test_two_servers_have_nothing_in_common():
    one, other = Door(1), Door(1)
    assert len({one.token, one.pass_word, other.token, other.pass_word}) == 4
    assert min(map(len, (one.token, one.pass_word))) >= 32
    assert one.token not in repr(one)
    # No browser sends a fragment.
    assert one.link == f"http://127.0.0.1:1/#token={one.token}"


def test_a_browser_is_told_to_load_and_run_nothing_else(page):
    for path in ("/", "/assets/main.js", FOLDER, "/nowhere"):
        headers = page.get(path).headers
        policy = dict(
            part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";")
        )
        assert policy["default-src"] == "'none'"
        assert policy["script-src"] == policy["connect-src"] == "'self'"
        assert policy["frame-ancestors"] == "'none'"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"


def test_large_requests_are_refused_whatever_they_say_of_their_length(page, monkeypatch):
    monkeypatch.setattr(guard, "FORM_BYTES", 1000)
    name = {"name": "x" * 2000}
    assert page.post("/api/jobs", json=name).status_code == 413
    pieces = (b"x" * 100 for _ in range(20))
    assert page.post("/api/jobs", content=pieces).status_code == 413
    assert page.post("/api/jobs", json={"name": "nowhere"}).status_code == 404
    for length in ("-1", "1e3", "", "²"):
        assert page.get(FOLDER, headers={"Content-Length": length.encode()}).status_code == 413


def test_what_nobody_has_foreseen_is_an_answer_too(page, monkeypatch):
    monkeypatch.setattr("counterspin.application.server.answer", lambda *_: 1 / 0)
    told = page.get(FOLDER)
    assert (told.status_code, told.json()["error"][:34]) == (
        500,
        "internal error (ZeroDivisionError:",
    )
