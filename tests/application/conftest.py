"""A folder that is served, with a campaign and its result, and who may ask for it."""

import shutil
import warnings

import pytest
from chromium import chromium, open_context
from served import InlineJobs, serving, token_of, write_folder

from counterspin.application.access_control import Credentials
from counterspin.application.app_state import AppState
from counterspin.application.served_folder import ServedFolder
from counterspin.application.server import make_application

with warnings.catch_warnings():
    # It asks for the successor of httpx, which is not among our pins.
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient

PORT = 8765


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Return a folder with a campaign, "three", its records and its result."""
    return write_folder(tmp_path_factory.mktemp("served"), tmp_path_factory.mktemp("plan"))


@pytest.fixture
def folder(made, tmp_path):
    """Return a copy of it, which a test may change; times of files are kept."""
    return shutil.copytree(made, tmp_path / "served")


@pytest.fixture
def app(folder):
    app = AppState(ServedFolder(folder))
    yield app
    app.close()


@pytest.fixture
def inline_jobs(app):
    """Do jobs at once, in this process."""
    app.jobs = InlineJobs()


@pytest.fixture
def credentials():
    return Credentials(PORT)


@pytest.fixture
def stranger(app, credentials):
    """Return a client that knows the address, and no key."""
    with TestClient(
        make_application(app, credentials), base_url=f"http://127.0.0.1:{PORT}"
    ) as client:
        client.headers["Origin"] = f"http://127.0.0.1:{PORT}"
        yield client


@pytest.fixture
def page(stranger, credentials):
    """Return a client that came by the link, as the page does."""
    told = stranger.post("/api/session", json={"token": token_of(credentials)})
    stranger.headers["Authorization"] = f"Bearer {told.json()['key']}"
    return stranger


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def door_of_server(app):
    """Return the credentials of a server that runs."""
    with serving(app) as credentials:
        yield credentials


class Window:
    """A window, what it asked for elsewhere, and what went wrong in it."""

    def __init__(self, context, link):
        self.away, self.wrong = [], []
        self.tab = context.new_page()
        own = link.partition("#")[0]
        self.tab.on("request", lambda r: None if r.url.startswith(own) else self.away.append(r.url))
        self.tab.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.tab.on("console", self.hear)
        self.tab.goto(link)

    def hear(self, said):
        # That an answer was no is said on the page.
        if said.type == "error" and "Failed to load resource" not in said.text:
            self.wrong.append(said.text)


@pytest.fixture
def opened(browser, door_of_server):
    """Return what opens windows; nothing may go wrong in any, and no request may leave."""
    context, credentials = open_context(browser), door_of_server
    windows = []

    def open_window(place=None):
        link = credentials.link
        if place is not None:
            # As one that has come by the link before.
            key = credentials.exchange_token(token_of(credentials))
            context.add_init_script(f"sessionStorage.setItem('counterspin-key', '{key}')")
            link = f"{link.partition('#')[0]}#{place}"
        windows.append(Window(context, link))
        return windows[-1].tab

    yield open_window
    for window in windows:
        assert window.wrong == []
        assert [url for url in window.away if not url.startswith("data:")] == []
    context.close()
