"""Access control: only the page itself, by its address and with the key, is served."""

import asyncio

import pytest
from served import read_token

from counterspin.application import access_control
from counterspin.application.access_control import Credentials

FOLDER = "/api/folder"


def test_page_request_is_accepted(page):
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
def test_foreign_host_is_rejected(page, path, host):
    """DNS rebinding shows in the Host header but not in Origin."""
    del page.headers["Origin"]
    assert page.get(path, headers={"Host": host}).status_code == 403


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "localhost:8765", "LOCALHOST:8765"])
def test_loopback_host_names_are_accepted(page, host):
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
def test_foreign_origin_is_rejected(page, method, origin):
    assert page.request(method, FOLDER, headers={"Origin": origin}).status_code == 403


def test_post_without_origin_is_rejected(page):
    del page.headers["Origin"]
    assert page.get(FOLDER).status_code == 200
    assert page.post("/api/jobs", json={"name": "three"}).status_code == 403
    assert page.get("/api/jobs").json() == []


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_cross_site_fetch_is_rejected(page, site):
    assert page.get(FOLDER, headers={"Sec-Fetch-Site": site}).status_code == 403


def test_request_without_key_is_unauthorized(anonymous, credentials):
    assert anonymous.get("/").status_code == 200
    assert anonymous.get(FOLDER).status_code == 401
    assert anonymous.post("/api/session", json={"token": "x" * 32}).status_code == 403
    for odd in ("", "[]", '{"token": null}', '{"token": "\u00e4"}', "[" * 3999):
        assert anonymous.post("/api/session", content=odd.encode()).status_code == 403
    assert anonymous.get(FOLDER).status_code == 401
    other = Credentials(1234)
    for said in (read_token(credentials), other.exchange_token(read_token(other)), ""):
        anonymous.headers["Authorization"] = f"Bearer {said}"
        assert anonymous.get(FOLDER).status_code == 401


def test_session_key_is_not_set_as_cookie(anonymous, credentials):
    response = anonymous.post("/api/session", json={"token": read_token(credentials)})
    assert "set-cookie" not in response.headers
    key = response.json()["key"]
    anonymous.cookies.set("counterspin-8765", key)
    assert anonymous.get(FOLDER).status_code == 401
    both = [("Authorization", f"Bearer {said}") for said in (key, "x")]
    assert anonymous.get(FOLDER, headers=both).status_code == 401
    assert anonymous.get(FOLDER, headers=both[:1]).status_code == 200


def test_link_is_valid_once_and_next_link_is_printed(anonymous, credentials):
    printed_lines = []
    credentials.on_token_used = printed_lines.append
    first = {"token": read_token(credentials)}
    assert anonymous.post("/api/session", json=first).status_code == 200
    assert anonymous.post("/api/session", json=first).status_code == 403
    assert printed_lines == [credentials.link]
    assert (
        anonymous.post("/api/session", json={"token": read_token(credentials)}).status_code == 200
    )
    assert printed_lines[1] == credentials.link
    assert len({*printed_lines, f"http://127.0.0.1:8765/#token={first['token']}"}) == 3


def test_servers_do_not_share_credentials():
    first, second = Credentials(1), Credentials(1)
    # Browsers do not send fragments.
    assert first.link.startswith("http://127.0.0.1:1/#token=")
    tokens = read_token(first), read_token(second)
    all_tokens = {
        *tokens,
        *(
            credentials.exchange_token(t)
            for credentials, t in zip((first, second), tokens, strict=True)
        ),
    }
    assert len(all_tokens) == 4
    assert min(map(len, all_tokens)) >= 32


def _request_ticket(page, **said):
    return page.post("/api/ticket", json={"name": "file", "parameters": said})


def test_download_ticket_is_valid_once_and_for_one_file(page):
    file = {"name": "three/campaign.toml"}
    ticket = _request_ticket(page, **file).json()["ticket"]
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


def test_tickets_are_limited_to_downloads_and_page(page):
    assert page.post("/api/ticket", json={"name": "folder", "parameters": {}}).status_code == 400
    outside = _request_ticket(page, name="../outside.toml").json()["ticket"]
    assert page.get(f"/api/ticket/{outside}").status_code == 403
    del page.headers["Authorization"]
    assert _request_ticket(page, name="three/campaign.toml").status_code == 401


def test_oldest_tickets_expire(monkeypatch):
    tickets, now = access_control.Tickets(), [0.0]
    monkeypatch.setattr(access_control.time, "monotonic", lambda: now[0])
    first = tickets.issue("first")
    many = [tickets.issue(number) for number in range(100)]
    assert tickets.redeem(first) is None
    assert tickets.redeem(many[0]) == 0
    now[0] = 61.0
    assert tickets.redeem(many[1]) is None


def test_content_security_policy_allows_only_same_origin(page):
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


def test_oversized_request_is_rejected_with_or_without_length(page, monkeypatch):
    monkeypatch.setattr(access_control, "FORM_MAX_BYTES", 1000)
    name = {"name": "x" * 2000}
    assert page.post("/api/jobs", json=name).status_code == 413
    pieces = (b"x" * 100 for _ in range(20))
    assert page.post("/api/jobs", content=pieces).status_code == 413
    assert page.post("/api/jobs", json={"name": "nowhere"}).status_code == 404
    for length in ("-1", "1e3", "", "²"):
        assert page.get(FOLDER, headers={"Content-Length": length.encode()}).status_code == 413


def test_large_upload_without_key_is_rejected_unread(anonymous, monkeypatch):
    read = []
    monkeypatch.setattr("starlette.requests.Request.body", lambda *_: read.append(1))
    much = b"x" * 5000
    for path, status in (("/api/session", 413), (FOLDER, 401), ("/", 413), ("/api/files", 401)):
        answer = anonymous.post(path, content=much)
        assert (answer.status_code, answer.headers["connection"]) == (status, "close")
    assert read == []


def test_number_of_large_forms_in_memory_is_limited(credentials):
    """Otherwise fifty forms of 4 MB would occupy 200 MB."""
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

    key = credentials.exchange_token(read_token(credentials))
    headers = {"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:8765"}
    headers["authorization"] = f"Bearer {key}"
    sent = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": "POST", "path": "/api/jobs", "headers": sent}

    async def ask():
        guarded = access_control.AccessControl(app, credentials)
        await asyncio.gather(*(guarded(dict(scope), receive, send) for _ in range(forms)))

    asyncio.run(ask())
    assert held == [0]
    # The first chunks of the other forms.
    assert most[0] <= 2 * size + (forms - 2) * 200_000


def test_unexpected_exception_returns_status_500(page, monkeypatch):
    monkeypatch.setattr("counterspin.application.server.handle_request", lambda *_: 1 / 0)
    response = page.get(FOLDER)
    assert (response.status_code, response.json()["error"][:34]) == (
        500,
        "internal error (ZeroDivisionError:",
    )
