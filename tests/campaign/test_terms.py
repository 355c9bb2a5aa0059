import numpy as np
import pytest
from campaigns import write_and_read_campaign
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site

from counterspin.campaign.model import MeasurementSetup, resolve_model
from counterspin.campaign.quantity import Quantity, read_attitude_matrix
from counterspin.campaign.settings import ModelSettings
from counterspin.campaign.terms import BARE_NAMES, acting_rows
from counterspin.campaign.validation import Problems
from counterspin.physics.accelerometer import QX, QY, QZ, Mounting
from counterspin.physics.closed_forms import parabola
from counterspin.physics.motion import Site
from counterspin.physics.terms import SHARED_TERMS

LEVEL = np.eye(3)
OBLIQUE = Mounting.from_axes([1.0, 1.0, 0.0], "down")
ARCSEC = np.pi / 648000


def acts(row, mounting, attitude):
    return row.effect.acts_on(mounting.turned(attitude).input_axis, attitude)


def resolve_terms(mountings, attitudes=(LEVEL,), given=None, **settings):
    problems = Problems({})
    given = {name: {} for name in mountings} | (given or {})
    on = MeasurementSetup(mountings, {}, attitudes, (), 0, None, None)
    model, priors = resolve_model(ModelSettings(**settings), given, on, problems, 9.8)
    return model, priors, problems.lines


def expand_name(bare, mountings, attitudes=(LEVEL,)):
    model, _, problems = resolve_terms(mountings, attitudes, terms=["K_II", bare])
    assert model.terms[0] == "K_II"
    components = [symbol.removeprefix(f"{bare}.") for symbol in model.terms[1:]]
    return " ".join(components) or problems[0]


@pytest.mark.parametrize(
    ("mountings", "tilt", "azimuth"),
    [
        ({"Qx": QX}, "north", "yy zx"),
        ({"Qy": QY}, "east", "xy zy"),
        ({"Qx": QX, "Qy": QY}, "east north", "xy yy zx zy"),
        ({"Q": OBLIQUE}, "east north", "xy yy zx zy"),
        # The level gyros rotate the level force into the vertical, again after half a turn.
        ({"Qx": QX, "Qz": QZ}, "north", "xx yy zx"),
    ],
)
def test_bare_names_expand_to_acting_components(mountings, tilt, azimuth):
    assert expand_name("platform.tilt", mountings) == tilt
    assert expand_name("platform.drift", mountings) == tilt
    assert expand_name("platform.g_sensitivity", mountings) == azimuth


def test_no_component_acts_on_vertical_input_axis():
    assert expand_name("platform.tilt", {"Qz": QZ}) == (
        'model.terms[1]: no component of "platform.tilt" affects these accelerometers to first '
        "order; omit it, or name a single component, such as platform.tilt.east"
    )


def test_gyro_terms_rotate_with_platform():
    # x east, y up, z south: the azimuth gyro is y, and the gyro about north is -z.
    turned = read_attitude_matrix("90 deg about east")
    assert expand_name("platform.tilt", {"Qx": QX}, [turned]) == "north"
    assert expand_name("platform.drift", {"Qx": QX}, [turned]) == "up"
    assert expand_name("platform.g_sensitivity", {"Qx": QX}, [turned]) == "yx zz"
    assert expand_name("platform.drift", {"Qx": QX}, [LEVEL, turned]) == "north up"


@pytest.mark.parametrize("attitude", ["level", "90 deg about east", "30 deg about north"])
@pytest.mark.parametrize("mounting", [QX, QY, QZ, OBLIQUE], ids=["Qx", "Qy", "Qz", "oblique"])
def test_acting_tilts_couple_gravity(mounting, attitude):
    rows = read_attitude_matrix(attitude)
    gravity = np.array([0.0, 0.0, Site(9.8, 0.7).gravity])
    input_axis = mounting.matrix[0] @ rows
    for row in BARE_NAMES["platform.tilt"]:
        leak = -np.cross(np.eye(3)[row.effect.axis], gravity) @ input_axis  # -(psi x f)
        assert acts(row, mounting, rows) == (abs(leak) > 1e-6)


@pytest.mark.parametrize(
    ("symbol", "mounting", "reaches"),
    [("yz", QX, True), ("xz", QX, False), ("zz", QX, False), ("xz", QY, True), ("yz", QZ, False)],
)
def test_g_sensitivity_to_gravity_acts_as_drift(symbol, mounting, reaches):
    row = SHARED_TERMS[f"platform.g_sensitivity.{symbol}"]
    about = {"x": "east", "y": "north", "z": "up"}[symbol[0]]
    drift = SHARED_TERMS[f"platform.drift.{about}"]
    assert acts(row, mounting, LEVEL) == acts(drift, mounting, LEVEL) == reaches


def test_component_prior_overrides_bare_name():
    model, _, problems = resolve_terms(
        {"Qx": QX, "Qy": QY},
        terms=["K_II", "platform.tilt"],
        priors={
            "platform.tilt.north": "0 ± 2 arcsec",
            "platform.tilt": "0 ± 1 arcsec",
        },
    )
    assert problems == []
    assert model.priors["platform.tilt.east"].u == pytest.approx(ARCSEC, rel=1e-14)
    assert model.priors["platform.tilt.north"].u == pytest.approx(2 * ARCSEC, rel=1e-14)
    assert set(model.priors) == {f"platform.tilt.{axis}" for axis in ("east", "north", "up")}


@pytest.mark.parametrize("order", [1, -1])
def test_head_component_prior_overrides_general_priors(tmp_path, order):
    stated = [
        '"head.harmonic.1.sin" = "0 ± 3 arcsec"\n',
        '"head.harmonic.1" = "0 ± 2 arcsec"\n',
        '"head.harmonic" = "0 ± 1 arcsec"\n',
    ]
    rest_runs = (
        format_rest_run(f"{angle}", f"{angle} deg about north", "1 mA") for angle in (0, 60, 120)
    )
    text = (
        format_site() + ACCELEROMETER + "".join(["[model.priors]\n", *stated[::order], *rest_runs])
    )
    priors = write_and_read_campaign(tmp_path, text).model.priors
    rounded_values = {symbol: round(prior.u / ARCSEC, 9) for symbol, prior in priors.items()}
    first = {"head.harmonic.1.cos": 2.0, "head.harmonic.1.sin": 3.0}
    others = {f"head.harmonic.{n}.{wave}": 1.0 for n in (2, 3, 4) for wave in ("cos", "sin")}
    assert rounded_values == {**first, **others}


def test_accelerometer_prior_overrides_common_prior():
    _, priors, problems = resolve_terms(
        {"Qx": QX, "Qy": QY},
        terms=["K_II"],
        hold=["K_OO"],
        priors={"Qx.K_OO": "1 ± 2 ug/g^2", "K_OO": "0 ± 1 ug/g^2"},
    )
    assert problems == []
    assert priors["Qx"] == {"K_OO": Quantity(1e-6, 2e-6, "g/g^2")}
    assert priors["Qy"] == {"K_OO": Quantity(0.0, 1e-6, "g/g^2")}


def test_unquoted_dotted_keys_are_accepted():
    model, priors, problems = resolve_terms(
        {"Qx": QX},
        terms=["K_II", "platform.tilt"],
        priors={"platform": {"tilt": "0 ± 1 arcsec"}, "Qx": {"K_II": "0 ± 1 g/g^2"}},
        limits={"platform": {"tilt": "1 deg"}, "K_II": "1e-3 g/g^2"},
    )
    assert problems == []
    assert "K_II" in priors["Qx"]
    assert model.priors["platform.tilt.north"].u == pytest.approx(ARCSEC, rel=1e-14)
    tilts = [model.limits[f"platform.tilt.{name}"] for name in ("east", "north", "up")]
    assert tilts == pytest.approx([np.pi / 180] * 3, rel=1e-14)
    assert model.limits["K_II"] == 1e-3


def test_held_terms_require_prior_for_all_accelerometers():
    given = {"Qx": {"K_OO": Quantity(0.0, 1e-6, "g/g^2")}}
    _, _, (problem,) = resolve_terms(
        {"Qx": QX, "Qy": QY}, given=given, terms=["K_II"], hold=["K_OO"]
    )
    assert problem == (
        'model.hold: "K_OO" is held, but no prior is stated for Qy; '
        'add "K_OO" = "VALUE ± U g/g^2" to [model.priors]'
    )


@pytest.mark.parametrize(
    ("assume", "taken", "not_taken"),
    [
        (["K_OO"], "K_OO", "K_PP K_IO K_F.trend centrifuge.radius platform.tilt.north"),
        (["K_F"], "K_F K_F.trend K_F.heating", "K_I K_II"),
        (
            ["platform.*"],
            "platform.tilt.north platform.drift.up platform.g_sensitivity.zx",
            "K_OO centrifuge.stretch encoder.harmonic.1.cos",
        ),
        (
            ["platform.tilt"],
            "platform.tilt.east platform.tilt.north platform.tilt.up",
            "platform.drift.north platform.tilting",
        ),
        (
            ["centrifuge.radius", "records.timing_offset"],
            "centrifuge.radius centrifuge.radius.in records.timing_offset",
            "centrifuge.stretch site.gravity",
        ),
        ("all", "K_OO platform.tilt.north centrifuge.radius head.zero", ""),
        (["K_PP", "all"], "K_OO platform.tilt.north centrifuge.radius head.zero", ""),
        ([], "", "K_OO platform.tilt.north centrifuge.radius"),
    ],
)
def test_assume_selects_terms(assume, taken, not_taken):
    model, _, problems = resolve_terms({"Qx": QX}, terms=["K_II"], assume=assume)
    assert problems == []
    assert [symbol for symbol in taken.split() if not model.assumes(symbol)] == []
    assert [symbol for symbol in not_taken.split() if model.assumes(symbol)] == []


@pytest.mark.parametrize(
    ("assume", "problem"),
    [
        (["K_II", "K_OOO"], 'model.assume[1]: unknown term "K_OOO"; did you mean "K_OO"?'),
        (
            ["plattform.*"],
            'model.assume[0]: unknown term "plattform.*"; did you mean "platform"?',
        ),
        ("al", 'model.assume[0]: unknown term "al"; did you mean "all"?'),
        (["platform.tlt"], 'unknown term "platform.tlt"; did you mean "platform.tilt"?'),
    ],
)
def test_assume_rejects_unknown_or_inactive_term(assume, problem):
    _, _, (message,) = resolve_terms({"Qx": QX}, terms=["K_F"], assume=assume)
    assert message.endswith(problem)


@pytest.mark.parametrize("key", ["hold", "considered"])
@pytest.mark.parametrize("name", ["K_OO", "platform.tilt"])
def test_rejects_term_both_held_and_assumed(key, name):
    known = {"K_OO": "0 ± 1e-6 g/g^2", "platform.tilt": "0 ± 1 arcsec"}
    held = {"terms": ["K_II"], key: [name], "priors": known}
    _, _, (problem,) = resolve_terms({"Qx": QX}, assume=["K_PP", name], **held)
    assert problem == f'model.assume[1]: "{name}" is also in model.{key}; keep only one of them'
    # Only unstated terms of a family are assumed.
    assert resolve_terms({"Qx": QX}, assume="all", **held)[2] == []


def test_considered_is_alias_of_hold():
    known = {"K_OO": "0 ± 1e-6 g/g^2", "K_PP": "0 ± 1e-6 g/g^2"}
    old, new = (
        resolve_terms({"Qx": QX}, terms=["K_II"], priors=known, **{key: ["K_OO"]})
        for key in ("considered", "hold")
    )
    assert old == new
    assert new[0].considered == ("K_OO",)
    _, _, (problem,) = resolve_terms(
        {"Qx": QX}, terms=["K_II"], priors=known, hold=["K_OO"], considered=["K_PP"]
    )
    assert problem == "model.considered: this key is the former name of hold; keep only hold"


def test_unrequested_term_may_have_prior():
    model, priors, problems = resolve_terms(
        {"Qx": QX},
        terms=["K_II"],
        priors={"K_OO": "1 ± 2 ug/g^2", "platform.drift.up": "0 ± 0.01 deg/h"},
    )
    assert problems == []
    assert priors["Qx"] == {"K_OO": Quantity(1e-6, 2e-6, "g/g^2")}
    assert set(model.priors) == {"platform.drift.up"}
    assert model.considered == ()


def test_terms_require_accelerometer_coefficient():
    _, _, (problem,) = resolve_terms({"Qx": QX}, terms=["platform.tilt"])
    assert problem == "model.terms: contains no accelerometer term to estimate"


def test_platform_terms_have_bare_names():
    assert {row.symbol for rows in BARE_NAMES.values() for row in rows} == {
        symbol for symbol in SHARED_TERMS if symbol not in ("centrifuge.stretch", "table.lever_arm")
    }


def test_acting_sensitivity_has_mean_at_some_start_angle():
    """Compare with the closed form at start angle zero and after a quarter turn."""
    quarter = Mounting.from_axes("south", "down"), Mounting.from_axes("east", "down")
    for row in BARE_NAMES["platform.g_sensitivity"]:
        if row.effect.force_axis == 2:
            continue  # a drift has no mean, only a t^3 term
        for mounting, turned in zip((QX, QY), quarter, strict=True):
            # A quarter turn about up maps x to y: the same machine at another start angle.
            means = [
                parabola(symbol, axes, 1.7, 2.5, 9.8)
                for symbol, axes in ((row.symbol, mounting), (_turn_symbol(row.symbol), turned))
            ]
            assert acts(row, mounting, LEVEL) == any(abs(mean) > 1e-9 for mean in means)
            meant = row in acting_rows("platform.g_sensitivity", [mounting], [LEVEL])
            assert meant == (abs(means[0]) > 1e-9)


def _turn_symbol(symbol):
    family, _, pair = symbol.rpartition(".")
    return f"{family}.{pair.translate(str.maketrans('xy', 'yx'))}"


def test_typical_sizes_can_be_changed():
    model, _, problems = resolve_terms(
        {"Qx": QX},
        terms=["K_II"],
        typical={
            "platform": {"tilt": "2 arcsec"},
            "K_OO": "1e-7 g/g^2",
            "platform.tilt.up": "1 deg",
        },
    )
    assert problems == []
    assert model.typical["K_OO"] == 1e-7
    assert model.typical["platform.tilt.north"] == pytest.approx(2 * ARCSEC, rel=1e-14)
    assert model.typical["platform.tilt.up"] == pytest.approx(np.radians(1.0), rel=1e-14)
    assert "K_PP" not in model.typical


def test_sizes_of_all_terms_can_be_stated():
    """Including inputs and machine terms, also of a single mounting."""
    sizes = {
        "site.gravity": ("1e-3 m/s^2", 1e-3),
        "centrifuge.radius": ("0.1 mm", 1e-4),
        "centrifuge.radius.in": ("2 mm", 2e-3),
        "centrifuge.droop": ("2e-9 rad s^2", 2e-9),
        "head.zero": ("1 arcsec", ARCSEC),
        "records.timing_offset": ("1 us", 1e-6),
        "K_F.trend": ("1e-9 g/s", 1e-9),
    }
    written = {symbol: text for symbol, (text, _) in sizes.items()}
    model, _, problems = resolve_terms({"Qx": QX}, terms=["K_II"], typical=written, limits=written)
    assert problems == []
    for symbol, (_, size) in sizes.items():
        assert model.typical[symbol] == pytest.approx(size, rel=1e-14)
        assert model.limits[symbol] == pytest.approx(size, rel=1e-14)
    assert set(model.typical) == set(model.limits) == set(sizes)
    _, _, (problem,) = resolve_terms(
        {"Qx": QX}, terms=["K_II"], typical={"centrifuge.radios": "1 mm"}
    )
    assert problem.startswith('model.typical."centrifuge.radios": unknown term')


def test_path_names_expand_to_harmonics_and_quadratures():
    assert expand_name("encoder.harmonic.3", {"Qx": QX}) == "cos sin"
    assert expand_name("centrifuge.imbalance", {"Qx": QX}) == "1.cos 1.sin 2.cos 2.sin"
    model, _, problems = resolve_terms(
        {"Qx": QX},
        terms=["K_II", "centrifuge.imbalance"],
        priors={"centrifuge.imbalance": "0 ± 2 um", "centrifuge.imbalance.2": "0 ± 1 um"},
        typical={"encoder.harmonic.1": "3 arcsec", "encoder": {"harmonic": "2 arcsec"}},
    )
    assert problems == []
    assert [prior.u for prior in model.priors.values()] == [2e-6, 2e-6, 1e-6, 1e-6]
    for harmonic, arcsec in ((1, 3.0), (4, 2.0)):
        size = model.typical[f"encoder.harmonic.{harmonic}.cos"]
        assert size == pytest.approx(arcsec * ARCSEC, rel=1e-14)


def test_path_errors_do_not_act_on_vertical_axis():
    assert "no component" in expand_name("encoder.harmonic", {"Qz": QZ})
    assert not acts(SHARED_TERMS["centrifuge.stretch"], QZ, LEVEL)
    assert acts(SHARED_TERMS["centrifuge.stretch"], QY, LEVEL)
