"""Nothing that a description says takes all memory, or goes on without end."""

import resource
import subprocess
import sys
from contextlib import contextmanager

import pytest
from campaigns import SMALL, replace_parts, write_description
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.runs import MAX_COMPUTED_ROWS, MAX_SIMULATED_ROWS
from counterspin.errors import CampaignError, CounterspinError
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import check
from counterspin.simulation.simulable import check_size, count_computed_rows
from counterspin.simulation.simulate import simulate
from counterspin.studies.study import study


@contextmanager
def limit_memory():
    """Make what takes 4 GB more than a test does fail, before it takes them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (6 * 2**30, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


DRIFT = ('drift = "1e-6 1/s"\n', "")
SLOW = ('rate = "0.5 rev/s"', 'rate = "{}"')


def read_changed_campaign(tmp_path, old, new):
    # A rotation that drifts for so long would be wrong for another reason.
    return write_description(tmp_path, replace_parts(SMALL, (old, new), DRIFT))


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
def test_excessive_run_length_raises_with_reason(tmp_path, old, new):
    """Where a bound were missing, the allocation itself would fail: see `limit_memory`."""
    campaign = read_changed_campaign(tmp_path, old, new)
    for work in (
        lambda: check(campaign),
        lambda: forecast(campaign),
        lambda: study(campaign, trials=2),
        lambda: simulate(campaign, tmp_path / "records"),
        lambda: simulate(campaign),
    ):
        with limit_memory(), pytest.raises(CampaignError) as caught:
            work()
        problem, *_ = caught.value.problems
        assert problem.startswith("runs[")
        assert "rev/s, sampled at 20 Hz" in problem
        assert "choose fewer revolutions, a shorter duration" in problem
    assert not (tmp_path / "records").exists()


def test_sampling_rate_does_not_limit_forecast(tmp_path):
    """A forecast uses means, so 1e6 samples per revolution are equivalent to 64."""
    campaign = read_changed_campaign(
        tmp_path, 'sampling_rate = "20 Hz"', 'sampling_rate = "1e5 Hz"'
    )
    assert forecast(campaign).u["Qx.K_II"] > 0.0
    for work in (lambda: study(campaign, trials=2), lambda: simulate(campaign, tmp_path / "x")):
        with limit_memory(), pytest.raises(CampaignError, match="sampled at 1e\\+05 Hz"):
            work()


def test_computed_rows_match_calibration():
    w = 2.0 * 3.141592653589793
    assert count_computed_rows(w, 100.0, 50.0, is_averaged=False) == pytest.approx(6400.0)
    assert count_computed_rows(w, 100.0, 1000.0, is_averaged=False) == 1e5
    assert count_computed_rows(w, 100.0, 1000.0, is_averaged=True) == pytest.approx(1e5 / 15)
    # A block has 8192 samples at most.
    assert count_computed_rows(1e-9, 1e6, 1000.0, is_averaged=True) == pytest.approx(1e9 / 8192)
    assert count_computed_rows(1e-300, 1e300, 1e300, is_averaged=True) == float("inf")


def test_forecast_limits_total_rows_of_runs(tmp_path):
    """A simulation processes runs sequentially; a forecast needs all runs in memory."""
    campaign = read_campaign(
        read_changed_campaign(tmp_path, "revolutions = 20", "revolutions = 8000")
    )
    alone = [
        count_computed_rows(run.rate, run.duration, 20.0, is_averaged=True) for run in campaign.runs
    ]
    assert max(alone) < MAX_COMPUTED_ROWS < sum(alone)
    with pytest.raises(CampaignError, match="of the"):
        forecast(campaign)


def test_simulation_allows_more_rows_than_study(tmp_path):
    """A simulation needs only the samples of a single run in memory."""
    campaign = read_campaign(
        read_changed_campaign(tmp_path, "revolutions = 20", "revolutions = 20")
    )
    longest = max(run.duration for run in campaign.runs)
    fits, too_many = 0.99 * MAX_SIMULATED_ROWS / longest, 1.01 * MAX_SIMULATED_ROWS / longest
    check_size(campaign, fits, "simulation")
    for rate, purpose in ((too_many, "simulation"), (fits, "study")):
        with pytest.raises(CampaignError, match=f"a {purpose} can have at most"):
            check_size(campaign, rate, purpose)


def test_excessive_trial_count_raises(tmp_path):
    campaign = write_description(tmp_path, SMALL)
    with limit_memory(), pytest.raises(CounterspinError, match="`trials`"):
        study(campaign, trials=10**15)
    with limit_memory(), pytest.raises(CounterspinError, match="require too much memory"):
        study(campaign, trials=10**9, engine="full")
    text = SMALL + "\n[study]\ntrials = 1000000000000000\n"
    with pytest.raises(CampaignError, match=r"study\.trials"):
        study(write_description(tmp_path, text, "other.toml"))


@pytest.mark.slow
def test_command_reports_excessive_run_in_one_sentence(tmp_path):
    """The memory limit is smaller than one column of the record."""
    campaign = read_changed_campaign(tmp_path, *(text.format("1e-9 rev/s") for text in SLOW))
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


def test_too_many_records_for_forecast_raise(tmp_path):
    head, tail = SMALL.split("\n[[runs]]\n", 1)
    _, simulation, tail = tail.partition("[simulation]")
    many = "".join(
        f'\n[[runs]]\nname = "r{i}"\nrate = "1 rev/s"\nrecord = "r{i}.csv"\n' for i in range(31)
    )
    campaign = write_description(tmp_path, f"{head}{many}{simulation}{tail}")
    with raises("too-many-rows", "62 records", "60"):
        forecast(campaign)
