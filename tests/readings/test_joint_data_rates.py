"""Rates, clocks and radii of readings on the arm, against a generator of closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from raising import raises

import counterspin as cs
from counterspin.calibration.model import make_unknowns
from counterspin.readings.joint_data import estimate_with_readings

GRAVITY, LATITUDE, EARTH = 9.8066, math.radians(45.0), 7.292115e-5
TRUTH = {"K_F": 2e-3, "K_I": 1.0005, "K_II": 1.5e-5, "K_III": 1e-6}
SIZES = np.sqrt(np.array([1.0, 3.0, 5.0, 7.0, 9.0, 11.0, 13.0, 15.0]) * GRAVITY)
SIGMA = U_BIAS = 2e-6

#: Where the input axis points in each mounting, and its specific force over R (w^2 + ...).
SIDES = {"in": ("inward", 1.0), "out": ("outward", -1.0)}


def indicate_force(rates, radius, sign):
    """Return the mean readings of an accelerometer with the pendulous axis up, g."""
    force = sign * radius * (rates**2 + 2.0 * rates * EARTH * math.sin(LATITUDE)) / GRAVITY
    return sum(value * force**power for power, value in enumerate(TRUTH.values()))


def make_arm_campaign(
    folder, *, more="", spread="", u=SIGMA, sides=SIDES, names=("A",), radius="1.0 m"
):
    """Return a campaign of 8 rates in each mounting, whose readings are zero yet."""
    uncertain = f" ± {u}" if u else ""
    read = ", ".join(f'{name} = "0{uncertain} g"' for name in names)
    runs = "".join(
        f'[[runs]]\nname = "{side} {w:.3f}"\nmotion = "arm"\nrate = "{w!r}{spread} rad/s"\n'
        f'mounting = "{side}"\naxes = {{ input = "{SIDES[side][0]}", pendulous = "up" }}\n'
        f"reading = {{ {read} }}\n"
        for side in sides
        for w in SIZES.tolist()
    )
    tables = "".join(
        f'[accelerometers.{name}]\ninput_axis = "up"\npendulous_axis = "west"\n'
        f'bias = "{TRUTH["K_F"]} ± {U_BIAS} g"\n'
        for name in names
    )
    text = (
        f'schema = 1\nsite = {{ gravity = "{GRAVITY} m/s^2", latitude = "45 deg" }}\n'
        f'[centrifuge]\nradius = "{radius}"\n{tables}{more}{runs}'
    )
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return cs.read_campaign(folder)


def fill_readings(of, rng, *, rate_errors=0.0, radii=(), sigma=SIGMA):
    """Return a campaign with what is read at true rates and radii.

    rate_errors: Of the true rates, relative; one for all, or one for each reading.
    radii: (accelerometer, mounting) -> radius of the proof mass, m.
    """
    radii = dict(radii)
    rates = np.array([r.rate for r in of.readings]) * (1.0 + rate_errors)
    values = [
        float(
            indicate_force(w, radii.get((r.accelerometer, r.mounting), 1.0), SIDES[r.mounting][1])
        )
        for r, w in zip(of.readings, rates, strict=True)
    ]
    # The bias is drawn from its stated prior.
    values = np.array(values) + rng.normal(0.0, U_BIAS) + rng.normal(0.0, sigma, len(values))
    read = zip(of.readings, values.tolist(), strict=True)
    return replace(of, readings=tuple(replace(r, value=v, resolution=0.0) for r, v in read))


def z_scores(of, model):
    """Return z of the coefficients of A."""
    estimate, _ = estimate_with_readings(None, model, of)
    solution = estimate.fit.solution
    return {
        u.symbol: (solution.estimate[i] + u.nominal - TRUTH[u.symbol]) / solution.u[i]
        for i, u in enumerate(model.unknowns)
        if u.owner == "A" and u.symbol in ("K_I", "K_II", "K_III")
    }


TERMS = 'terms = ["K_F", "K_I", "K_II", "K_III"]\n'
ASSUMED = f'[model]\nassume = ["all"]\n{TERMS}'


def rms_bounds(trials, count=3):
    """Return the bounds of `count` rms of z, one in a thousand of good ones beyond: chi-square."""
    from scipy.stats import chi2

    tail = 0.5e-3 / count
    return np.sqrt(chi2.ppf([tail, 1.0 - tail], trials) / trials)


def assert_good(z):
    rms = {k: math.sqrt(np.mean([one[k] ** 2 for one in z])) for k in z[0]}
    low, high = rms_bounds(len(z))
    assert all(low < size < high for size in rms.values()), rms


@pytest.mark.parametrize("u", [SIGMA, None])
def test_random_rate_errors_are_in_u(tmp_path, u):
    of = make_arm_campaign(tmp_path, more=ASSUMED, spread=" ± 1e-5", u=u)
    rng, model = np.random.default_rng(1), make_unknowns(of)
    rates = np.array([r.rate for r in of.readings])
    errors = rng.normal(0.0, 1e-5, (60, rates.size)) / rates
    assert_good([z_scores(fill_readings(of, rng, rate_errors=error), model) for error in errors])


def test_clock_error_of_20_ppm_is_within_default_u(tmp_path):
    # The radius is well known here: the clock is most of u.
    known = "".join(f'"centrifuge.radius{name}" = "1e-7 m"\n' for name in ("", ".in", ".out"))
    of = make_arm_campaign(tmp_path, more=f"[model]\n{TERMS}[model.typical]\n{known}")
    for error in (2e-5, -2e-5):
        result = cs.calibrate(fill_readings(of, np.random.default_rng(2), rate_errors=error))
        k_i = result.accelerometers["A"].coefficients["K_I"]
        assert abs(k_i.value - TRUTH["K_I"] - 2.0 * error) < 3e-6
        assert abs(k_i.value - TRUTH["K_I"]) < 3.0 * k_i.u < 1.5e-4
        assert result.state == "good", result.findings


@pytest.mark.parametrize("key", ["[records]", "[centrifuge]"])
def test_stated_clock_corrects_rates_and_is_in_u(tmp_path, key):
    clock = 'clock = "100 ± 3 ppm"\n'
    time = 'time = { column = "t", unit = "s" }\n'
    more, radius = f"{key}\n{time}{clock}", "1.0 m"
    if key == "[centrifuge]":
        more, radius = "", f'1.0 m"\n{clock}#'
    of = make_arm_campaign(tmp_path, more=more + ASSUMED, sides=["in"], radius=radius)
    # The clock counts too few revolutions.
    result = cs.calibrate(fill_readings(of, np.random.default_rng(3), rate_errors=1e-4))
    k_i = result.accelerometers["A"].coefficients["K_I"]
    assert abs(k_i.value - TRUTH["K_I"]) < 3.0 * k_i.u
    assert k_i.u_stated == pytest.approx(math.hypot(6e-6, 1e-6), rel=0.05)
    says_which = any("[records] clock also applies" in remark for remark in result.warnings)
    assert says_which == (key == "[records]")


OFFSET = 3e-5
RADII = [("A", "in"), ("A", "out"), ("B", "in"), ("B", "out")]


def make_two_accelerometer_campaign(folder):
    priors = "".join(f'"centrifuge.radius.{a}.{m}" = "0 ± {OFFSET} m"\n' for a, m in RADII)
    more = f"{ASSUMED}[model.priors]\n{priors}"
    return make_arm_campaign(folder, more=more, names=("A", "B"), radius="1.0 m")


def test_radii_drawn_from_priors_are_in_u(tmp_path):
    of = make_two_accelerometer_campaign(tmp_path)
    rng, model = np.random.default_rng(4), make_unknowns(of)
    z = [
        z_scores(
            fill_readings(of, rng, radii={key: 1.0 + rng.normal(0.0, OFFSET) for key in RADII}),
            model,
        )
        for _ in range(60)
    ]
    assert_good(z)


def test_separate_proof_mass_radii_are_good(tmp_path):
    of = make_arm_campaign(
        tmp_path, more=f"[model]\n{TERMS}", names=("A", "B"), radius="1.0 ± 1e-3 m"
    )
    places = dict(zip(RADII, (1.00001, 0.99999, 1.0001, 1.0001), strict=True))
    result = cs.calibrate(fill_readings(of, np.random.default_rng(5), radii=places))
    assert result.state == "good"
    for name in ("A", "B"):
        for symbol in ("K_I", "K_II", "K_III"):
            c = result.accelerometers[name].coefficients[symbol]
            assert abs(c.value - TRUTH[symbol]) < 3.0 * c.u
        assert result.accelerometers[name].coefficients["K_II"].u < 3e-7
    a = result.accelerometers["A"]
    sources = {line.source: line.contribution for line in a.budget["K_II"]}
    assert {"centrifuge.radius.A.in", "centrifuge.radius.A.out"} <= sources.keys()
    # Only by way of the misalignments of the mountings, which both share.
    u = a.coefficients["K_II"].u
    assert all(abs(size) < 1e-5 * u for s, size in sources.items() if "radius.B" in s)


def test_accelerometers_share_radius_of_mounting(tmp_path):
    priors = '[model.priors]\n"centrifuge.radius.in" = "1.0002 ± 1e-6 m"\n'
    of = make_arm_campaign(tmp_path, more=ASSUMED + priors, names=("A", "B"), sides=["in"])
    names = [u.name for u in make_unknowns(of).unknowns if "radius" in u.name]
    assert names == ["centrifuge.radius.in"]
    both = {(name, "in"): 1.0002 for name in "AB"}
    result = cs.calibrate(fill_readings(of, np.random.default_rng(6), radii=both))
    for name in "AB":
        k_i = result.accelerometers[name].coefficients["K_I"]
        assert abs(k_i.value - TRUTH["K_I"]) < 3.0 * k_i.u < 5e-6


def test_conflicting_radius_priors_raise(tmp_path):
    priors = (
        '[model.priors]\n"centrifuge.radius.in" = "0 ± 1e-6 m"\n'
        '"centrifuge.radius.A.in" = "0 ± 1e-6 m"\n'
    )
    with raises("conflicting-keys", '"centrifuge.radius.in"'):
        make_arm_campaign(tmp_path, more=ASSUMED + priors)


def test_random_rate_errors_have_budget_line(tmp_path):
    kinds = {}
    for spread in ("", " ± 1e-5"):
        of = make_arm_campaign(tmp_path, more=f"[model]\n{TERMS}", spread=spread)
        result = cs.calibrate(fill_readings(of, np.random.default_rng(7)))
        c = result.accelerometers["A"].coefficients["K_III"]
        lines = result.accelerometers["A"].budget["K_III"]
        (line,) = (one for one in lines if one.source == "centrifuge.rate")
        kinds[line.kind] = line.contribution
        assert c.u**2 == pytest.approx(c.u_noise**2 + c.u_stated**2 + c.u_unstated**2)
        assert sum(one.share for one in lines) == pytest.approx(1.0, abs=1e-9)
    assert kinds["stated"] > 3.0 * kinds["unstated"] > 0.0
