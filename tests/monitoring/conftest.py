"""A small campaign whose runs say how long they last, and its records as files."""

import shutil

import frames
import pytest

import counterspin as cs


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    document = frames.small()
    del document["accelerometers"]["Qy"], document["truth"]["Qy"]
    document["simulation"]["revolutions"] = 15
    folder = tmp_path_factory.mktemp("monitoring") / "campaign"
    cs.simulate(cs.make_campaign(document)).write(folder)
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "campaign")
