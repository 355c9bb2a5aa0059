"""Observed runs: each record is held to the motion that the campaign describes."""

import math
import re

import polars as pl
import pytest
from campaigns import SMALL, campaign_of, changed

from counterspin.calibration.observed import observe
from counterspin.campaign.simulation import simulate
from counterspin.errors import RecordError

#: What an observable's columns are called in the description, and its noise.
OBSERVED = {"velocity": ("m/s", "0.01 m/s"), "specific_force": ("g", "1e-4 g")}


def described(observable):
    """The small campaign, of another observable."""
    unit, noise = OBSERVED[observable]
    pairs = [
        (
            f'displacement = {{ column = "{axis}_m", unit = "m" }}',
            f'{observable} = {{ column = "{axis}", unit = "{unit}" }}',
        )
        for axis in ("east", "north")
    ]
    return changed(SMALL, *pairs, ('displacement = "0.01 m"', f'{observable} = "{noise}"'))


@pytest.fixture(scope="module", params=OBSERVED)
def recorded(request, tmp_path_factory):
    """Such a campaign's folder and description, and one record as it was made."""
    folder = tmp_path_factory.mktemp(request.param)
    text = described(request.param)
    simulate(campaign_of(folder, text), folder)
    return folder, text, pl.read_csv(folder / "slow.csv")


def test_a_record_of_the_motion_is_read(recorded):
    folder, text, _ = recorded
    assert len(list(observe(campaign_of(folder, text)))) == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (pl.col("east") * -1.0, "180 degrees"),
        (pl.col("north").alias("east"), "check the input axis"),
        (pl.col("east") * 1000.0, "check the column's unit"),
        (pl.col("east") * 9.80665, "that between g and m/s^2"),
        (pl.col("angle_rad") + math.pi / 2, "90 degrees"),
        (pl.col("angle_rad") * -1.0, "opposite sense"),
    ],
    ids=["sign", "axes", "thousand", "gravity", "zero", "sense"],
)
def test_a_record_that_is_not_of_the_motion_is_refused(recorded, tmp_path, change, words):
    folder, text, record = recorded
    for file in folder.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    record.with_columns(change).write_csv(tmp_path / "slow.csv")
    with pytest.raises(RecordError, match=re.escape(words)) as caught:
        list(observe(campaign_of(tmp_path, text)))
    assert "slow.csv" in str(caught.value)


@pytest.mark.parametrize("radius", ["0.9 m", "25 m"])
def test_a_radius_that_is_far_off_is_refused(recorded, radius):
    folder, text, _ = recorded
    with pytest.raises(RecordError, match="the radius"):
        list(observe(campaign_of(folder, changed(text, ('"2.5 m"', f'"{radius}"')))))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    simulate(campaign_of(folder, SMALL), folder)
    return folder


@pytest.mark.parametrize("name", ["copy.csv", "copy.parquet", "sub/../slow.csv"])
def test_the_same_record_twice_is_refused(plain, tmp_path, name):
    (tmp_path / "sub").mkdir()
    record = pl.read_csv(plain / "slow.csv")
    for file in plain.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    record.write_csv(tmp_path / "copy.csv")
    record.write_parquet(tmp_path / "copy.parquet")
    again = f'[[runs]]\nname = "again"\nrate = "0.25 rev/s"\nrecord = "{name}"\n\n[simulation]'
    with pytest.raises(RecordError, match=r"holds the same samples as .*slow\.csv"):
        list(observe(campaign_of(tmp_path, changed(SMALL, ("[simulation]", again)))))
