"""File formats, parts and exclusion of runs."""

import math

import pytest
from campaigns import SMALL, replace_parts, write_description
from raising import raises

from counterspin.campaign import consistency_checks
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError
from counterspin.records.dialect import Dialect
from counterspin.simulation.simulate import simulate

ANGLE = 'angle = { column = "angle_rad", unit = "rad" }'
TIME = 'time = { column = "time_s", unit = "s" }'


def read_changed(folder, *pairs):
    return read_campaign(write_description(folder, replace_parts(SMALL, *pairs)))


def list_problems(folder, *pairs):
    with pytest.raises(CampaignError) as caught:
        read_changed(folder, *pairs)
    return caught.value.problems


@pytest.mark.parametrize(
    ("keys", "factor", "offset"),
    [
        ('unit = "deg"', math.radians(1), 0.0),
        ('unit = "deg", sense = "clockwise", zero = "north"', -math.radians(1), math.pi / 2),
        ('unit = "rad", zero = "-30 deg"', 1.0, math.radians(-30)),
        ('unit = "count", per_revolution = 4096', math.tau / 4096, 0.0),
        ('unit = "count", per_revolution = 4096, sense = "clockwise"', -math.tau / 4096, 0.0),
        ('sense = "clockwise"', -1.0, 0.0),
    ],
)
def test_angle_is_converted_to_right_handed(tmp_path, keys, factor, offset):
    angle = read_changed(tmp_path, (ANGLE, f'angle = {{ column = "a", {keys} }}')).angle
    assert angle.factor == pytest.approx(factor, rel=1e-15)
    assert angle.offset == pytest.approx(offset)


def test_run_overrides_file_format(tmp_path):
    own = 'name = "middle"\nrecords = { decimal = ",", time = { unit = "ms" } }\nstop = "30 s"'
    changed_campaign = read_changed(
        tmp_path, (ANGLE, f'{ANGLE}\ndelimiter = ";"\nskip_lines = 4'), ('name = "middle"', own)
    )
    slow, middle, _ = changed_campaign.runs
    assert changed_campaign.recording_of(slow).dialect == Dialect(skip_lines=4, delimiter=";")
    assert changed_campaign.recording_of(middle).dialect == Dialect(
        skip_lines=4, delimiter=";", decimal=","
    )
    assert changed_campaign.recording_of(middle).time.factor == 1e-3
    assert middle.time_range == (-math.inf, 30.0)


def test_run_can_be_skipped(tmp_path):
    changed_campaign = read_changed(tmp_path, ('name = "middle"', 'name = "middle"\nskip = true'))
    assert [run.name for run in changed_campaign.runs] == ["slow", "fast"]
    assert changed_campaign.skipped == ("middle",)
    everything = [
        (f'name = "{n}"', f'name = "{n}"\nskip = true') for n in ("slow", "middle", "fast")
    ]
    assert list_problems(tmp_path, *everything) == ("runs: are all excluded by skip = true",)


def test_file_may_contain_consecutive_runs(tmp_path):
    def two_parts(first, second):
        return [
            ('record = "slow.csv"', f'record = "all.csv"\n{first}'),
            ('record = "middle.csv"', f'record = "all.csv"\n{second}'),
        ]

    changed_campaign = read_changed(tmp_path, *two_parts('stop = "40 s"', 'start = "40 s"'))
    assert [run.time_range for run in changed_campaign.runs[:2]] == [
        (-math.inf, 40.0),
        (40.0, math.inf),
    ]
    for second in ('start = "39 s"', "", 'start = "x"'):
        problems = list_problems(tmp_path, *two_parts('stop = "40 s"', second))
        assert any("runs[0] already uses" in line or "start" in line for line in problems)
    with raises("not-simulable"):
        simulate(changed_campaign, tmp_path / "out")


@pytest.mark.parametrize("key", ["sheet", "group"])
def test_file_may_contain_run_per_table(tmp_path, key):
    def two_tables(first, second):
        return [
            ('record = "slow.csv"', f'record = "all.xlsx"\nrecords = {{ {key} = "{first}" }}'),
            ('record = "middle.csv"', f'record = "all.xlsx"\n{second}'),
        ]

    own = f'records = {{ {key} = "two" }}'
    changed_campaign = read_changed(tmp_path, *two_tables("one", own))
    assert [run.record.name for run in changed_campaign.runs[:2]] == ["all.xlsx"] * 2
    # One table, or a possibly identical one, belongs to one run.
    for first, second in (("two", own), ("one", "")):
        problems = list_problems(tmp_path, *two_tables(first, second))
        assert any("runs[0] already uses" in line for line in problems)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (TIME, "time = { unit = 's' }", "records.time: give a column or a sampling_rate"),
        (
            TIME,
            "time = { sampling_rate = '9 Hz', unit = 's' }",
            "records.time: a unit applies only to",
        ),
        (
            ANGLE,
            "angle = { column = 'a', unit = 'count' }",
            "records.angle: counts require per_rev",
        ),
        (ANGLE, "angle = { column = 'a', unit = 's' }", "records.angle.unit: 's' is not a unit of"),
        (ANGLE, "angle = { column = 'a', zero = 'up' }", "records.angle.zero: 'up' is not a q"),
        (
            ANGLE,
            "angle = { column = 'a', sense = 'left' }",
            "records.angle.sense: 'left' is not one",
        ),
        (ANGLE, f"{ANGLE}\nencoding = 'utf8000'", 'records.encoding: unknown encoding "utf8'),
        (ANGLE, f"{ANGLE}\ndelimiter = '|'", "records.delimiter: '|' is not one of ',', ';' or"),
        ('name = "slow"', 'name = "slow"\nstart = "9 s"\nstop = "8 s"', "runs[0].stop: must come"),
        (
            'name = "slow"',
            'name = "slow"\nmounting = "in"',
            "runs[0].mounting: applies to a run with a reading; omit it",
        ),
        (
            'name = "slow"',
            'name = "slow"\nrecords = { reference = 1 }',
            "runs[0].records.reference",
        ),
    ],
)
def test_errors_name_key(tmp_path, old, new, words):
    assert any(line.startswith(words) for line in list_problems(tmp_path, (old, new)))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            ANGLE,
            f"{ANGLE}\ndecimal = ','",
            "records.decimal: simulated records cannot have this key",
        ),
        (TIME, "time = { sampling_rate = '9 Hz' }", "contain a time column"),
        (
            TIME,
            "time = { column = 't', unit = 'iso' }",
            "records.time: simulated records contain numbers",
        ),
        (ANGLE, "angle = { column = 'a' }", "records.angle.unit: missing"),
        ('name = "slow"', 'name = "slow"\nrecords = { decimal = "." }', r'"slow", records.decimal'),
    ],
)
def test_rejects_simulation_of_unsupported_campaign(tmp_path, old, new, words):
    with pytest.raises(CampaignError, match=words):
        simulate(read_changed(tmp_path, (old, new)), tmp_path / "out")


def test_clock_is_assigned_per_recorder(tmp_path):
    def two_recorders(first, second):
        return [
            ('name = "slow"', f'name = "slow"\nrecords = {{ {first} }}'),
            ('name = "middle"', f'name = "middle"\nrecords = {{ {second} }}'),
        ]

    clock = 'recorder = "B", clock = "{} ± 1e-7"'
    changed_campaign = read_changed(
        tmp_path, *two_recorders('recorder = "B"', 'recorder = "C", clock = "1 ± 0.1 ppm"')
    )
    clocks = {
        run.recorder: run.clock for run in map(changed_campaign.recording_of, changed_campaign.runs)
    }
    assert list(clocks) == ["B", "C", ""]
    assert clocks["B"] is clocks[""] is None
    assert (clocks["C"].value, clocks["C"].u) == pytest.approx((1e-6, 1e-7))
    assert list_problems(tmp_path, *two_recorders(clock.format("0"), clock.format("1e-6"))) == (
        'runs: "slow" and "middle" state different clocks for the recorder "B"; state only one '
        "clock",
    )
    (nameless,) = list_problems(
        tmp_path, ('name = "slow"', 'name = "slow"\nrecords = { clock = "0" }')
    )
    assert "name the recorder of this clock" in nameless
    (slow,) = list_problems(tmp_path, (ANGLE, f'{ANGLE}\nclock = "0.02 ± 1e-7"'))
    assert "above 1 %" in slow


def test_run_is_compared_only_with_runs_of_same_record(monkeypatch):
    """Comparison with all runs took minutes for a description of 10,000 runs."""
    compared = []
    monkeypatch.setattr(
        consistency_checks, "_are_different_tables", lambda *two_tables: compared.append(two_tables)
    )
    listed = [(n, {"name": f"r{n}", "record": f"{n // 2}.csv"}) for n in range(200)]
    mistakes = list(consistency_checks._repeated_names_and_files({}, listed))
    assert [path for path, _ in mistakes] == [("runs", n, "record") for n in range(1, 200, 2)]
    assert len(compared) == 200
