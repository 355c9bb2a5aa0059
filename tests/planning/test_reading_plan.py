"""Plans of readings: tumbles, arm centrifuges, both; their order; what is not noticed."""

import json
import math
import re
from collections import Counter
from itertools import combinations_with_replacement

import numpy as np
import pytest
from raising import raises

from counterspin import calibrate, cli
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError, CounterspinError
from counterspin.planning.faults import fault_sensitivities, possible_faults
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import check, plan, write_campaign
from counterspin.planning.reading_plan import order_readings
from counterspin.planning.stations import read_reading_plan

HEAD = """
schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "45.75 deg" }
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
"""
TUMBLE = (
    HEAD
    + """
[model]
assume = "all"
terms = ["K_F", "K_I", "delta_O"]
[[stations]]
positions = 24
u = "1e-6 g"
[limits]
readings = 24
[goal]
minimise = { K_F = "1e-6 g", K_I = "1e-6 g/g", delta_O = "1e-6 rad" }
criterion = "determinant"
"""
)
SOUGHT = 'minimise = { K_F = "1e-6 g", K_I = "1e-6 g/g", delta_O = "1e-6 rad" }'
FORCES = ", ".join(f'"{size} g"' for size in (1, 2, 5, 10, 15, 20))
ARM = (
    HEAD
    + f"""
[centrifuge]
radius = "1.0 m"
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III"]
[[stations]]
name = "in"
motion = "arm"
axes = {{ input = "inward", pendulous = "forward" }}
specific_forces = [{FORCES}]
u = "2e-6 g"
time = "5 min"
[[stations]]
name = "out"
motion = "arm"
axes = {{ input = "outward", pendulous = "backward" }}
specific_forces = [{FORCES}]
u = "2e-6 g"
time = "5 min"
[limits]
readings = 24
[goal]
minimise = ["K_II"]
"""
)
REST = """
[[stations]]
name = "rest"
positions = 12
u = "1e-6 g"
time = "2 min"
[limits]"""


def u_of_symbol(result, symbol):
    return result.accelerometers["A"].coefficients[symbol].u


# Which readings


def test_d_optimal_tumble_has_equal_angles(write_plan):
    """D-optimality on a circle: every equally spaced set of positions has the same volume."""
    result = plan(write_plan(TUMBLE)).result
    expected = {"K_F": 1e-6 / math.sqrt(24.0), "K_I": 1e-6 / math.sqrt(12.0)}
    volume = math.prod(u_of_symbol(result, symbol) for symbol in ("K_F", "K_I", "delta_O"))
    assert volume == pytest.approx(expected["K_F"] * expected["K_I"] ** 2, rel=1e-6)
    assert result.goal.efficiency == pytest.approx(1.0, abs=1e-3)
    assert len(result.readings) == 24


def test_best_tumble_for_scale_factor_is_up_and_down(write_plan):
    one = (SOUGHT, 'minimise = ["K_I"]')
    result = plan(write_plan(TUMBLE, one, ('criterion = "determinant"', ""))).result
    assert {reading.axes.partition(",")[0] for reading in result.readings} == {"up", "down"}
    assert u_of_symbol(result, "K_I") == pytest.approx(1e-6 / math.sqrt(24.0), rel=1e-6)


def test_arm_plan_is_better_than_even_readings(write_plan):
    result = plan(write_plan(ARM)).result
    other = result.others[0]
    assert other.words == "every reading equally often"
    assert result.goal.efficiency > 0.95
    # For K_II both ways round count alike.
    ways = [reading.name.split()[1] for reading in result.readings]
    assert abs(ways.count("in") - ways.count("out")) <= 2
    assert other.ratio["A.K_II"] < 0.8
    # The published design: inputs of 1, 2, 5, 10, 15, 20 g both ways, weighted alike, twice.
    force = np.repeat([1.0, 2.0, 5.0, 10.0, 15.0, 20.0], 2) * np.tile([1.0, -1.0], 6)
    columns = np.vander(np.tile(force, 2), 4, increasing=True)
    covariance = 4e-12 * np.linalg.inv(columns.T @ columns)
    assert other.u["A.K_II"] == pytest.approx(math.sqrt(covariance[2, 2]), rel=1e-3)


def test_target_uses_fewest_readings(write_plan):
    target = ('minimise = ["K_II"]', 'target = { K_II = "1e-8 g/g^2" }')
    result = plan(write_plan(ARM, target)).result
    assert u_of_symbol(result, "K_II") <= 1e-8
    fewer = (target, ("readings = 24", f"readings = {len(result.readings) - 1}"))
    with raises("goal-not-reached", "u(A.K_II) = 1e-08 g/g^2"):
        plan(write_plan(ARM, *fewer))


DRIFTING = [
    ('assume = "all"', 'assume = "all"\npriors = { "K_F.trend" = "0 ± 1e-9 g/s" }'),
    ("positions = 24", 'positions = 24\ntime = "10 min"'),
    ('criterion = "determinant"', ""),
]


@pytest.mark.slow
def test_target_includes_drift(write_plan):
    """Read in the order of the angle, a drift of the bias looks like a misalignment."""

    def planned(order, goal):
        limit = ("readings = 24", f'readings = 24\norder = "{order}"')
        return plan(write_plan(TUMBLE, *DRIFTING, limit, (SOUGHT, goal))).result

    best = planned("listed", 'minimise = ["delta_O"]')
    u = u_of_symbol(best, "delta_O")
    steady = planned("mirrored", 'minimise = ["delta_O"]')
    assert u > 1.05 * u_of_symbol(steady, "delta_O")
    # The search knows nothing of it; what is stated of its plan does.
    ratio = u_of_symbol(steady, "delta_O") / u
    assert best.goal.efficiency == pytest.approx(ratio * steady.goal.efficiency, rel=1e-6)
    for more in (1.1, 1.3, 1.6):
        target = planned("listed", f'target = {{ delta_O = "{more * u!r} rad" }}')
        assert u_of_symbol(target, "delta_O") <= more * u
        assert len(target.readings) < len(best.readings)
        assert 0.1 < target.goal.efficiency < 1.0
    with pytest.raises(CounterspinError, match="no choice of readings") as raised:
        planned("listed", f'target = {{ delta_O = "{u * (1.0 - 1e-5)!r} rad" }}')
    # Digits that tell the two apart, and where the best comes from.
    matches, had = re.findall(r"(\d\.?\d*e-\d+) rad", str(raised.value))
    assert float(matches) < float(had)
    assert "; the variance comes from " in str(raised.value)


def test_plan_is_within_time_limit(write_plan):
    timed = ("readings = 24", 'total_time = "1 h"')
    two = ('minimise = ["K_II"]', 'minimise = { K_II = "1e-8 g/g^2", K_F = "1e-6 g" }')
    both = (("[limits]", REST), timed, two)
    result = plan(write_plan(ARM, *both)).result
    assert result.total_time <= 3600.0
    assert {reading.motion for reading in result.readings} == {"arm", "static"}
    times = [reading.time for reading in result.readings]
    assert times == sorted(times)
    target = ('minimise = ["K_II"]', 'target = { K_II = "1.5e-8 g/g^2" }')
    shorter = plan(write_plan(ARM, timed, target)).result
    assert shorter.total_time < 3600.0
    assert u_of_symbol(shorter, "K_II") <= 1.5e-8


def test_two_accelerometers_share_reading(write_plan):
    second = ("[model]", '[accelerometers.B]\ninput_axis = "up"\npendulous_axis = "east"\n[model]')
    result = plan(write_plan(TUMBLE, second)).result
    assert {reading.accelerometer for reading in result.readings} == {"A", "B"}
    assert u_of_symbol(result, "K_I") == pytest.approx(
        result.accelerometers["B"].coefficients["K_I"].u
    )


@pytest.mark.slow
def test_hand_set_positions_are_read_once(write_plan, tmp_path):
    """Repeated readings of a position determine its positioning error, not the misalignment."""
    changes = (
        ("[limits]", '[fixture]\nposition = "0 ± 20 arcsec"\n[limits]'),
        ("positions = 24", "positions = 12"),
        ("readings = 24", "readings = 40"),
        (SOUGHT, 'target = { delta_O = "7 arcsec" }'),
        ('criterion = "determinant"', ""),
    )
    planned = plan(write_plan(TUMBLE, *changes))
    times = Counter(reading.axes for reading in planned.result.readings)
    assert set(times.values()) == {1}
    assert len(times) == math.ceil((20.0 / 7.0) ** 2)
    file = write_campaign(planned, tmp_path / "planned")
    filled = file.read_text(encoding="utf-8").replace('"? ', '"0.001 ')
    file.write_text(filled, encoding="utf-8")
    assert u_of_symbol(check(file.parent), "delta_O") == pytest.approx(
        u_of_symbol(planned.result, "delta_O")
    )


# From the plan to the calibration


def test_calibration_matches_forecast_of_plan(write_plan, tmp_path):
    planned = plan(write_plan(ARM, ("[limits]", REST)))
    folder = tmp_path / "planned"
    file = write_campaign(planned, folder)
    with raises("missing-value", "reading:", "23"):
        read_campaign(file)
    blank = file.read_text(encoding="utf-8")
    lines = iter(planned.result.readings)
    truth = {"in": lambda a: a + 1.5e-5 * a**2, "out": lambda a: -a + 1.5e-5 * a**2}
    filled = []
    for line in blank.splitlines():
        if line.startswith("reading ="):
            reading = next(lines)
            way = reading.name.split()[1]
            size = reading.specific_force if way in truth else 0.0
            attitude = float(reading.name.split()[2]) if way == "rest" else 0.0
            value = truth[way](size) if way in truth else math.cos(math.radians(attitude))
            filled.append(line.replace("?", f"{value:.9f}"))
        else:
            filled.append(line)
    file.write_text("\n".join(filled), encoding="utf-8")
    coefficients = calibrate(folder).accelerometers["A"].coefficients
    for symbol, predicted in planned.result.accelerometers["A"].coefficients.items():
        assert coefficients[symbol].estimated == predicted.estimated
        if predicted.estimated:
            assert coefficients[symbol].u == pytest.approx(predicted.u, rel=1e-3), symbol
    checked = check(folder)
    assert u_of_symbol(checked, "K_II") == pytest.approx(
        u_of_symbol(planned.result, "K_II"), rel=1e-6
    )
    assert len(checked.readings) == len(planned.result.readings)


def test_forecast_of_readings_requires_uncertainty(write_plan, tmp_path):
    file = write_campaign(plan(write_plan(TUMBLE)), tmp_path / "planned")
    text = file.read_text(encoding="utf-8").replace("? ± 1e-6 g", "0 g")
    file.write_text(text, encoding="utf-8")
    with raises("missing-key"):
        forecast(file)


@pytest.mark.parametrize("order", ["mirrored", "random", "listed"])
def test_order_contains_readings_by_count(order):
    counts = np.array([3, 0, 2, 5, 1])
    assert np.bincount(order_readings(counts, order), minlength=5).tolist() == counts.tolist()


def test_mirrored_order_cancels_trend():
    order = np.array(order_readings(np.array([4, 2, 6, 0, 2]), "mirrored"))
    assert order.tolist() == order[::-1].tolist()
    time = np.arange(order.size) - 0.5 * (order.size - 1)
    for place in set(order.tolist()):
        assert time[order == place].sum() == pytest.approx(0.0)
    # Not all of one after all of another.
    assert np.count_nonzero(np.diff(order)) > 8


# What is not noticed


@pytest.mark.parametrize("ways", [("in",), ("in", "out")], ids=["one side", "both sides"])
def test_stretch_of_arm_shifts_k_ii(ways, write_plan, tmp_path):
    """a_I (1 + 4.6e-9 x 9.80665 |a_I|) is K_II on one side; with reversal it is odd."""
    runs = [
        f'[[runs]]\nname = "{way} {force}"\nmotion = "arm"\nreading = "0 ± 1e-6 g"\n'
        f'rate = "{math.sqrt(force * 9.80665)!r} rad/s"\n'
        f'axes = {{ input = "{way}ward", pendulous = "forward" }}\n'
        for force in range(1, 21)
        for way in ways
    ]
    text = ARM.partition("[[stations]]")[0] + "\n".join(runs)
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    prediction = forecast(tmp_path)
    responses = fault_sensitivities(prediction, possible_faults(prediction.campaign, "A"))
    stretch = next(
        response for response in responses if response.fault.symbol == "centrifuge.stretch"
    )
    place = [unknown.name for unknown in prediction.fit.model.unknowns].index("A.K_II")
    shift = stretch.shift(place)
    expected = 4.6e-9 * 9.80665 if len(ways) == 1 else 0.0
    # The Earth's rate is in the radius's force and not in the stretch.
    assert shift == pytest.approx(expected, rel=1e-4, abs=1e-11)


def test_report_and_json_contain_readings(write_plan, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    out = tmp_path / "planned"
    file = write_plan(ARM, ("[limits]", REST))
    assert cli.main(["plan", str(file), "-o", str(out), "--json", str(tmp_path / "p.json")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "24 readings" in printed
    assert "in mirrored order" in printed
    assert "Effects on A that the plan cannot detect" in printed
    assert "every reading equally often" in printed or "distributed evenly" in printed
    assert "Replace each ? with the reading" in printed
    document = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))
    assert document["runs"] == []
    assert document["sampling_rate"] is None
    assert len(document["readings"]) == 24
    assert document["accelerometers"]["A"]["harmonic_share"] is None
    assert {fault["symbol"] for fault in document["accelerometers"]["A"]["faults"]} >= {"K_4"}


# Bad input


MISTAKES = {
    "axis": (
        [("positions = 24", 'positions = 24\nabout = "sideways"')],
        TUMBLE,
        r'stations\[0\]\.about: unknown direction "sideways"',
    ),
    "rates at rest": ([('positions = 24', 'rates = ["1 rad/s"]')], TUMBLE,
                      "a station at rest has no rates"),
    "no rates": ([(f"specific_forces = [{FORCES}]", "")], ARM, "either rates or specific_forces"),
    "both": ([('positions = 24', 'positions = 24\nattitudes = ["level"]')], TUMBLE,
             "either positions or attitudes"),
    "twice": ([('name = "out"', 'name = "in"')], ARM, 'two entries have the name "in 1 g"'),
    "no u": ([('u = "1e-6 g"', "")], TUMBLE, r"stations\[0\].u: is missing"),
    "unit": ([('u = "1e-6 g"', 'u = "1e-6 V"')], TUMBLE, "'V' is not a unit"),
    "no limit": ([("readings = 24", "")], TUMBLE, "give readings or total_time"),
    "no time": ([("readings = 24", 'total_time = "1 h"')], TUMBLE, "requires the time of a"),
    "unknown": ([('minimise = ["K_II"]', 'minimise = ["K_OO"]')], ARM, '"K_OO" is not estimated'),
    "no machine": ([('[centrifuge]\nradius = "1.0 m"\n', "")], ARM, "centrifuge: is missing"),
    "section": ([("[limits]", "[truth]\n[limits]")], TUMBLE, "truth: unknown key"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "text", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_plan_raises_with_key(changes, text, message, write_plan):
    with pytest.raises(CampaignError, match=message):
        plan(write_plan(text, *changes))


@pytest.mark.parametrize(
    ("triad", "message"),
    [
        ("3", "must be a list"),
        ('["X", "Y", ["Z"]]', "must be a string"),
        ('["X"]', "must have at least 3 entries"),
    ],
)
def test_invalid_triad_raises(tmp_path, triad, message):
    file = tmp_path / "plan.toml"
    text = _poses(9, '["X.K_F"]').replace('["X", "Y", "Z"]', triad)
    file.write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match=rf"triad\.accelerometers.*: {message}"):
        plan(file)


def test_k_ii_at_one_g_raises_not_identifiable(write_plan):
    quadratic = ('terms = ["K_F", "K_I", "delta_O"]', 'terms = ["K_F", "K_I", "K_II"]')
    goal = (SOUGHT, 'minimise = ["K_II"]')
    file = write_plan(TUMBLE, quadratic, goal, ('criterion = "determinant"', ""))
    with raises("not-identifiable", "A.K_II"):
        plan(file)


BESIDE = """
schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "0.8 rad" }
[centrifuge]
radius = "1.0 m"
[records]
time = { column = "t", unit = "s" }
angle = { column = "angle", unit = "rad" }
[accelerometers.A]
input_axis = "east"
pendulous_axis = "down"
displacement = { column = "m", unit = "m" }
[noise]
displacement = "1e-3 m"
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II"]
[[runs]]
name = "turntable"
rate = "9.9 rad/s"
revolutions = 20
record = "turntable.csv"
[[runs]]
name = "rest"
motion = "static"
attitude = "90 deg about north"
reading = "-1.0 ± 2e-5 g"
[[stations]]
motion = "arm"
axes = { input = "inward", pendulous = "forward" }
specific_forces = ["1 g", "5 g", "20 g"]
u = "1e-5 g"
[limits]
readings = 2
sampling_rate = "10 Hz"
[goal]
minimise = ["K_II"]
"""


def test_readings_complement_existing_campaign(tmp_path):
    """The chosen pair is the best of all pairs added to the record and the reading."""
    file = tmp_path / "PLAN.toml"
    file.write_text(BESIDE, encoding="utf-8")
    planned = plan(file)
    actual_u = planned.result.accelerometers["A"].coefficients["K_II"].u
    described = read_reading_plan(file)
    u = [
        forecast(described.campaign(pair), sampling_rate=10.0).u["A.K_II"]
        for pair in combinations_with_replacement(described.candidates, 2)
    ]
    assert actual_u == pytest.approx(min(u), rel=1e-9)
    assert len(planned.result.readings) == 2
    write_plan = write_campaign(planned, tmp_path / "there")
    text = (write_plan if write_plan.is_file() else write_plan / "campaign.toml").read_text("utf-8")
    assert 'name = "turntable"' in text
    assert text.count("?") >= 2


def test_records_in_reading_plan_require_sampling_rate(tmp_path):
    file = tmp_path / "PLAN.toml"
    file.write_text(BESIDE.replace('sampling_rate = "10 Hz"\n', ""), encoding="utf-8")
    with pytest.raises(CampaignError, match=r"limits.sampling_rate: this entry is missing"):
        plan(file)


def _poses(limits: int, sought: str, *, model: str = "", up: str = "") -> str:
    axes = {"X": ("east", "north"), "Y": ("north", "up"), "Z": ("up", "east")}
    text = 'schema = 1\nsite = { gravity = "9.81 m/s^2", latitude = "52 deg" }\n'
    for name, (along, across) in axes.items():
        text += f'[accelerometers.{name}]\ngrade = "consumer"\n'
        text += f'input_axis = "{along}"\npendulous_axis = "{across}"\n'
    text += f'[triad]\naccelerometers = ["X", "Y", "Z"]\n{model}\n[[stations]]\n'
    text += f'attitude = "unknown"\nu = "1e-4 g"\n{up}\n[limits]\nreadings = {limits}\n'
    return text + f"[goal]\nminimise = {sought}\n"


def test_poses_are_best_of_all_choices(tmp_path):
    ups = ["X", "-X", "Y", "-Y", "Z", "-Z", "X + Y + Z", "-X - Y - Z"]
    model = '[model]\nassume = "all"\nterms = ["K_F", "K_I"]\n'
    file = tmp_path / "plan.toml"
    file.write_text(_poses(9, '["X.K_F"]', model=model, up=f"up = {json.dumps(ups)}"))
    planned_u = plan(file).u["X.K_F"]
    # Of a pose one number is left: what is felt along the force. Bias i acts on it by the
    # force's part n_i, sensitivity i by its square.
    n = np.array([*np.kron(np.eye(3), [[1.0], [-1.0]]), [3**-0.5] * 3, [-(3**-0.5)] * 3])
    design = np.hstack([n, n**2]) / 1e-4
    each = design[:, :, None] * design[:, None, :]
    choices = np.array(list(combinations_with_replacement(range(len(ups)), 9)))
    counts = (choices[:, :, None] == np.arange(len(ups))).sum(axis=1)
    weak = 1e-3 * np.eye(6)
    u = np.sqrt(np.linalg.inv(np.tensordot(counts, each, axes=1) + weak)[:, 0, 0])
    assert planned_u == pytest.approx(u.min(), rel=2e-3)
    assert np.median(u) > 1.2 * u.min()


def test_eighteen_poses_are_near_bound(tmp_path):
    file = tmp_path / "plan.toml"
    file.write_text(_poses(18, '["X.K_F", "Y.K_F", "Z.K_F"]'))
    result = plan(file).result
    assert result.goal is not None
    # Rounding alone ended 21 % above the bound, worse than an even spread.
    assert result.goal.efficiency > 0.97
    assert result.others
    assert all(ratio < 1.0 for ratio in result.others[0].ratio.values())
    assert all(reading.axes.startswith("up: ") for reading in result.readings)


@pytest.mark.slow
def test_ten_poses_are_searched_from_many_starts(tmp_path):
    """Six of them ended 45 % above the bound; of sixty the best is 21 % above it.

    The model has 27 terms, so ten poses are weighed beside what nobody states.
    """
    file = tmp_path / "plan.toml"
    file.write_text(_poses(10, '["X.K_F", "Y.K_F", "Z.K_F"]'))
    goal = plan(file).result.goal
    assert goal is not None
    assert goal.efficiency > 0.8


@pytest.mark.parametrize(
    ("up", "words"),
    [
        ('up = ["X + W"]', 'up[0]: "W" is not an accelerometer of the triad'),
        ('up = ["X - X"]', '"X" is listed twice'),
        ('up = ["-"]', "does not name an accelerometer"),
        ("positions = 4", "do not apply to poses at rest"),
    ],
)
def test_invalid_pose_limit_raises(tmp_path, up, words):
    file = tmp_path / "plan.toml"
    file.write_text(_poses(9, '["X.K_F"]', up=up))
    with pytest.raises(CampaignError, match=re.escape(words)):
        read_reading_plan(file)
