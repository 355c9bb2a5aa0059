"""Fixtures of a small campaign with stated durations, and its records as files."""

import shutil

import frames
import pytest

import counterspin as cs


@pytest.fixture(scope="session")
def campaign_files(tmp_path_factory):
    document = frames.parse_small_description()
    del document["accelerometers"]["Qy"], document["truth"]["Qy"]
    document["simulation"]["revolutions"] = 15
    folder = tmp_path_factory.mktemp("monitoring") / "campaign"
    cs.simulate(cs.make_campaign(document)).write(folder)
    return folder


@pytest.fixture
def folder(campaign_files, tmp_path):
    return shutil.copytree(campaign_files, tmp_path / "campaign")
