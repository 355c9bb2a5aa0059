"""A folder that is served, with a campaign and its result, and who may ask for it."""

import shutil
import warnings

import pytest
from served import token_of, write_folder

from counterspin.application.desk import Desk
from counterspin.application.folder import ServedFolder
from counterspin.application.guard import Door
from counterspin.application.server import application

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
def desk(folder):
    desk = Desk(ServedFolder(folder))
    yield desk
    desk.close()


@pytest.fixture
def door():
    return Door(PORT)


@pytest.fixture
def stranger(desk, door):
    """Return a client that knows the address, and no key."""
    with TestClient(application(desk, door), base_url=f"http://127.0.0.1:{PORT}") as client:
        client.headers["Origin"] = f"http://127.0.0.1:{PORT}"
        yield client


@pytest.fixture
def page(stranger, door):
    """Return a client that came by the link, as the page does."""
    told = stranger.post("/api/session", json={"token": token_of(door)})
    stranger.headers["Authorization"] = f"Bearer {told.json()['key']}"
    return stranger
