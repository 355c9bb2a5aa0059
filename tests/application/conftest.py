"""Fixtures of a served folder with a calibrated campaign, and clients for it."""

import shutil
import warnings

import pytest
from chromium import launch_chromium, open_context
from served import InlineJobs, read_token, run_server, write_folder

from counterspin.application.access_control import Credentials
from counterspin.application.app_state import AppState
from counterspin.application.served_folder import ServedFolder
from counterspin.application.server import make_application

with warnings.catch_warnings():
    # Starlette recommends the successor of httpx, which is not installed.
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient

PORT = 8765


@pytest.fixture(scope="session")
def calibrated_folder(tmp_path_factory):
    """Return a folder with a campaign, "three", its records and its result."""
    return write_folder(tmp_path_factory.mktemp("served"), tmp_path_factory.mktemp("plan"))


@pytest.fixture
def folder(calibrated_folder, tmp_path):
    """Return a copy of the calibrated folder for changes; modification times are preserved."""
    return shutil.copytree(calibrated_folder, tmp_path / "served")


@pytest.fixture
def app(folder):
    app = AppState(ServedFolder(folder))
    yield app
    app.close()


@pytest.fixture
def inline_jobs(app):
    """Run jobs synchronously in this process."""
    app.jobs = InlineJobs()


@pytest.fixture
def credentials():
    return Credentials(PORT)


@pytest.fixture
def anonymous(app, credentials):
    """Return a client without a session key."""
    with TestClient(
        make_application(app, credentials), base_url=f"http://127.0.0.1:{PORT}"
    ) as client:
        client.headers["Origin"] = f"http://127.0.0.1:{PORT}"
        yield client


@pytest.fixture
def page(anonymous, credentials):
    """Return a client with a session key, as the page has after following the link."""
    response = anonymous.post("/api/session", json={"token": read_token(credentials)})
    anonymous.headers["Authorization"] = f"Bearer {response.json()['key']}"
    return anonymous


@pytest.fixture(scope="module")
def browser():
    with launch_chromium() as started:
        yield started


@pytest.fixture
def server_credentials(app):
    """Return the credentials of a running server."""
    with run_server(app) as credentials:
        yield credentials


class Window:
    """A browser window with its external requests and its errors."""

    def __init__(self, context, link):
        self.away, self.wrong = [], []
        self.tab = context.new_page()
        own = link.partition("#")[0]
        self.tab.on("request", lambda r: None if r.url.startswith(own) else self.away.append(r.url))
        self.tab.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.tab.on("console", self.record_message)
        self.tab.goto(link)

    def record_message(self, message):
        # The page reports failed requests itself.
        if message.type == "error" and "Failed to load resource" not in message.text:
            self.wrong.append(message.text)


@pytest.fixture
def open_window(browser, server_credentials):
    """Return a function that opens windows; errors and external requests fail the test."""
    context, credentials = open_context(browser), server_credentials
    windows = []

    def open_window(place=None):
        link = credentials.link
        if place is not None:
            # As a window that followed the link before.
            key = credentials.exchange_token(read_token(credentials))
            context.add_init_script(f"sessionStorage.setItem('counterspin-key', '{key}')")
            link = f"{link.partition('#')[0]}#{place}"
        windows.append(Window(context, link))
        return windows[-1].tab

    yield open_window
    for window in windows:
        assert window.wrong == []
        assert [url for url in window.away if not url.startswith("data:")] == []
    context.close()
