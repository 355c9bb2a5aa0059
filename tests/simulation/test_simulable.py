"""Nothing that a description says takes all memory, or goes on without end."""

import resource
import subprocess
import sys
from contextlib import contextmanager

import pytest
from campaigns import SMALL, changed, write
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.runs import MOST_ROWS, MOST_SIMULATED_ROWS
from counterspin.errors import CampaignError, CounterspinError
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import check
from counterspin.simulation.simulable import check_size, computed_rows
from counterspin.simulation.simulate import simulate
from counterspin.studies.study import study


@contextmanager
def in_little_memory():
    """Make what takes 4 GB more than a test does fail, before it takes them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (6 * 2**30, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


DRIFT = ('drift = "1e-6 1/s"\n', "")
SLOW = ('rate = "0.5 rev/s"', 'rate = "{}"')


def asked(tmp_path, old, new):
    # A rotation that drifts for so long would be wrong for another reason.
    return write(tmp_path, changed(SMALL, (old, new), DRIFT))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('rate = "0.5 rev/s"', 'rate = "1e-8 rev/s"'),
        ('rate = "0.5 rev/s"', 'rate = "1e-30 rev/s"'),
        ('rate = "0.5 rev/s"', 'rate = "1e9 rev/s"\nduration = "100 s"'),
        ('rate = "0.5 rev/s"', 'rate = "0.5 rev/s"\nduration = "1e11 s"'),
        ("revolutions = 20", "revolutions = 1e12"),
        ("revolutions = 20", "revolutions = 1e308"),
    ],
)
def test_a_length_that_has_no_room_is_refused_with_its_reason(tmp_path, old, new):
    """Where a bound were missing, the allocation itself would fail: see `in_little_memory`."""
    campaign = asked(tmp_path, old, new)
    for work in (
        lambda: check(campaign),
        lambda: forecast(campaign),
        lambda: study(campaign, trials=2),
        lambda: simulate(campaign, tmp_path / "records"),
        lambda: simulate(campaign),
    ):
        with in_little_memory(), pytest.raises(CampaignError) as caught:
            work()
        problem, *_ = caught.value.problems
        assert problem.startswith("runs[")
        assert "rev/s, sampled at 20 Hz" in problem
        assert "choose fewer revolutions, a shorter duration" in problem
    assert not (tmp_path / "records").exists()


def test_a_sampling_rate_counts_for_what_takes_samples(tmp_path):
    """A forecast takes means: it knows no more of 1e6 samples of a revolution than of 64."""
    campaign = asked(tmp_path, 'sampling_rate = "20 Hz"', 'sampling_rate = "1e5 Hz"')
    assert forecast(campaign).u["Qx.K_II"] > 0.0
    for work in (lambda: study(campaign, trials=2), lambda: simulate(campaign, tmp_path / "x")):
        with in_little_memory(), pytest.raises(CampaignError, match="sampled at 1e\\+05 Hz"):
            work()


def test_rows_are_those_of_the_calibration():
    w = 2.0 * 3.141592653589793
    assert computed_rows(w, 100.0, 50.0, means=False) == pytest.approx(6400.0)
    assert computed_rows(w, 100.0, 1000.0, means=False) == 1e5
    assert computed_rows(w, 100.0, 1000.0, means=True) == pytest.approx(1e5 / 15)
    # A block has 8192 samples at most.
    assert computed_rows(1e-9, 1e6, 1000.0, means=True) == pytest.approx(1e9 / 8192)
    assert computed_rows(1e-300, 1e300, 1e300, means=True) == float("inf")


def test_runs_that_fit_alone_and_not_together(tmp_path):
    """A simulation makes one after the other, a forecast holds them all."""
    campaign = read_campaign(asked(tmp_path, "revolutions = 20", "revolutions = 8000"))
    alone = [computed_rows(run.rate, run.duration, 20.0, means=True) for run in campaign.runs]
    assert max(alone) < MOST_ROWS < sum(alone)
    with pytest.raises(CampaignError, match="of the"):
        forecast(campaign)


def test_a_simulation_has_more_room_than_a_study(tmp_path):
    """It writes one run after the other, and holds the samples of one alone."""
    campaign = read_campaign(asked(tmp_path, "revolutions = 20", "revolutions = 20"))
    longest = max(run.duration for run in campaign.runs)
    fits, too_many = 0.99 * MOST_SIMULATED_ROWS / longest, 1.01 * MOST_SIMULATED_ROWS / longest
    check_size(campaign, fits, "simulation")
    for rate, purpose in ((too_many, "simulation"), (fits, "study")):
        with pytest.raises(CampaignError, match=f"a {purpose} has room for"):
            check_size(campaign, rate, purpose)


def test_trials_that_nobody_can_keep(tmp_path):
    campaign = write(tmp_path, SMALL)
    with in_little_memory(), pytest.raises(CounterspinError, match="`trials`"):
        study(campaign, trials=10**15)
    with in_little_memory(), pytest.raises(CounterspinError, match="need too much memory"):
        study(campaign, trials=10**9, engine="full")
    text = SMALL + "\n[study]\ntrials = 1000000000000000\n"
    with pytest.raises(CampaignError, match=r"study\.trials"):
        study(write(tmp_path, text, "other.toml"))


@pytest.mark.slow
def test_the_command_says_it_in_a_sentence(tmp_path):
    """With less memory than one column of the record would take."""
    campaign = asked(tmp_path, *(text.format("1e-9 rev/s") for text in SLOW))
    for words in (["plan", "--check"], ["study"], ["simulate", "-o", str(tmp_path / "o")]):
        done = subprocess.run(
            [sys.executable, "-m", "counterspin", *words, str(campaign)],
            capture_output=True,
            check=False,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30,) * 2),
            timeout=300,
        )
        assert done.returncode == 2
        assert "at 1e-09 rev/s" in done.stderr
        assert "Traceback" not in done.stderr


def test_runs_that_nobody_forecasts(tmp_path):
    head, tail = SMALL.split("\n[[runs]]\n", 1)
    _, simulation, tail = tail.partition("[simulation]")
    many = "".join(
        f'\n[[runs]]\nname = "r{i}"\nrate = "1 rev/s"\nrecord = "r{i}.csv"\n' for i in range(31)
    )
    campaign = write(tmp_path, f"{head}{many}{simulation}{tail}")
    with raises("too-many-rows", "62 records", "60"):
        forecast(campaign)
