"""Who may ask: nobody but the page itself, by its own address, with the key."""

import asyncio

import pytest
from served import token_of

from counterspin.application import access_control
from counterspin.application.access_control import Credentials

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


def test_without_the_key_nothing_of_the_folder_is_told(stranger, credentials):
    assert stranger.get("/").status_code == 200
    assert stranger.get(FOLDER).status_code == 401
    assert stranger.post("/api/session", json={"token": "x" * 32}).status_code == 403
    for odd in ("", "[]", '{"token": null}', '{"token": "\u00e4"}', "[" * 3999):
        assert stranger.post("/api/session", content=odd.encode()).status_code == 403
    assert stranger.get(FOLDER).status_code == 401
    other = Credentials(1234)
    for said in (token_of(credentials), other.exchange_token(token_of(other)), ""):
        stranger.headers["Authorization"] = f"Bearer {said}"
        assert stranger.get(FOLDER).status_code == 401


def test_the_key_is_in_no_cookie_which_every_server_of_this_machine_would_get(
    stranger, credentials
):
    told = stranger.post("/api/session", json={"token": token_of(credentials)})
    assert "set-cookie" not in told.headers
    key = told.json()["key"]
    stranger.cookies.set("counterspin-8765", key)
    assert stranger.get(FOLDER).status_code == 401
    both = [("Authorization", f"Bearer {said}") for said in (key, "x")]
    assert stranger.get(FOLDER, headers=both).status_code == 401
    assert stranger.get(FOLDER, headers=both[:1]).status_code == 200


def test_a_link_counts_once_and_the_next_is_told(stranger, credentials):
    told = []
    credentials.on_token_used = told.append
    first = {"token": token_of(credentials)}
    assert stranger.post("/api/session", json=first).status_code == 200
    assert stranger.post("/api/session", json=first).status_code == 403
    assert told == [credentials.link]
    assert stranger.post("/api/session", json={"token": token_of(credentials)}).status_code == 200
    assert told[1] == credentials.link
    assert len({*told, f"http://127.0.0.1:8765/#token={first['token']}"}) == 3


def test_two_servers_have_nothing_in_common():
    one, other = Credentials(1), Credentials(1)
    # No browser sends a fragment.
    assert one.link.startswith("http://127.0.0.1:1/#token=")
    tokens = token_of(one), token_of(other)
    found = {
        *tokens,
        *(
            credentials.exchange_token(t)
            for credentials, t in zip((one, other), tokens, strict=True)
        ),
    }
    assert len(found) == 4
    assert min(map(len, found)) >= 32


def _ticket(page, **said):
    return page.post("/api/ticket", json={"name": "file", "said": said})


def test_a_file_is_saved_by_an_address_that_counts_once_and_for_it_alone(page):
    file = {"name": "three/campaign.toml"}
    ticket = _ticket(page, **file).json()["ticket"]
    assert len(ticket) >= 32
    del page.headers["Authorization"], page.headers["Origin"]
    assert page.get("/api/file", params=file).status_code == 401
    assert page.get("/api/file", params=file | {"ticket": ticket}).status_code == 401
    address = f"/api/ticket/{ticket}"
    assert page.get(address, headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403
    taken = page.get(address)
    assert b"[site]" in taken.content
    assert taken.headers["content-disposition"].startswith("attachment")
    for address in (f"/api/ticket/{ticket}", "/api/ticket/", "/api/ticket/x"):
        assert page.get(address).status_code == 404


def test_tickets_are_for_what_is_saved_and_are_given_to_the_page(page):
    assert page.post("/api/ticket", json={"name": "folder", "said": {}}).status_code == 400
    outside = _ticket(page, name="../outside.toml").json()["ticket"]
    assert page.get(f"/api/ticket/{outside}").status_code == 403
    del page.headers["Authorization"]
    assert _ticket(page, name="three/campaign.toml").status_code == 401


def test_old_tickets_count_no_longer(monkeypatch):
    tickets, now = access_control.Tickets(), [0.0]
    monkeypatch.setattr(access_control.time, "monotonic", lambda: now[0])
    first = tickets.issue("first")
    many = [tickets.issue(number) for number in range(100)]
    assert tickets.take(first) is None
    assert tickets.take(many[0]) == 0
    now[0] = 61.0
    assert tickets.take(many[1]) is None


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
    monkeypatch.setattr(access_control, "FORM_MAX_BYTES", 1000)
    name = {"name": "x" * 2000}
    assert page.post("/api/jobs", json=name).status_code == 413
    pieces = (b"x" * 100 for _ in range(20))
    assert page.post("/api/jobs", content=pieces).status_code == 413
    assert page.post("/api/jobs", json={"name": "nowhere"}).status_code == 404
    for length in ("-1", "1e3", "", "²"):
        assert page.get(FOLDER, headers={"Content-Length": length.encode()}).status_code == 413


def test_who_has_no_key_brings_little(stranger, monkeypatch):
    read = []
    monkeypatch.setattr("starlette.requests.Request.body", lambda *_: read.append(1))
    much = b"x" * 5000
    for path, status in (("/api/session", 413), (FOLDER, 401), ("/", 413), ("/api/files", 401)):
        answer = stranger.post(path, content=much)
        assert (answer.status_code, answer.headers["connection"]) == (status, "close")
    assert read == []


def test_large_forms_are_read_a_few_at_a_time(credentials):
    """Fifty of 4 MB at once would else hold 200 MB."""
    forms, size = 20, 1_000_000
    held, most = [0], [0]

    async def app(scope, receive, send):
        for _ in range(size // 100_000):
            await receive()
            held[0] += 100_000
            most[0] = max(most[0], held[0])
            await asyncio.sleep(0)
        held[0] -= size

    async def receive():
        return {"type": "http.request", "body": b"x" * 100_000, "more_body": True}

    async def send(_):
        pass

    key = credentials.exchange_token(token_of(credentials))
    headers = {"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:8765"}
    headers["authorization"] = f"Bearer {key}"
    sent = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": "POST", "path": "/api/jobs", "headers": sent}

    async def ask():
        guarded = access_control.AccessControl(app, credentials)
        await asyncio.gather(*(guarded(dict(scope), receive, send) for _ in range(forms)))

    asyncio.run(ask())
    assert held == [0]
    # Of the others, what came first.
    assert most[0] <= 2 * size + (forms - 2) * 200_000


def test_what_nobody_has_foreseen_is_an_answer_too(page, monkeypatch):
    monkeypatch.setattr("counterspin.application.server.handle_request", lambda *_: 1 / 0)
    told = page.get(FOLDER)
    assert (told.status_code, told.json()["error"][:34]) == (
        500,
        "internal error (ZeroDivisionError:",
    )
