import numpy as np
import pytest
from campaigns import campaign_of
from reading_descriptions import ACCELEROMETER, at_rest, place

from counterspin.campaign.model import MeasurementSetup, resolve_model
from counterspin.campaign.quantity import Quantity, attitude_rows
from counterspin.campaign.settings import ModelSettings
from counterspin.campaign.terms import BARE_NAMES, acts, rows_of
from counterspin.campaign.validation import Problems
from counterspin.physics.accelerometer import QX, QY, QZ, Mounting
from counterspin.physics.closed_forms import parabola
from counterspin.physics.motion import Site
from counterspin.physics.terms import SHARED_TERMS

LEVEL = np.eye(3)
OBLIQUE = Mounting.from_axes([1.0, 1.0, 0.0], "down")
ARCSEC = np.pi / 648000


def resolve(mountings, attitudes=(LEVEL,), given=None, **settings):
    problems = Problems({})
    given = {name: {} for name in mountings} | (given or {})
    on = MeasurementSetup(mountings, {}, attitudes, (), 0, None, None)
    model, priors = resolve_model(ModelSettings(**settings), given, on, problems, 9.8)
    return model, priors, problems.lines


def expanded(bare, mountings, attitudes=(LEVEL,)):
    model, _, problems = resolve(mountings, attitudes, terms=["K_II", bare])
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
        # The level gyros turn the level force into the vertical, half a turn later again.
        ({"Qx": QX, "Qz": QZ}, "north", "xx yy zx"),
    ],
)
def test_bare_names_mean_the_components_that_act(mountings, tilt, azimuth):
    assert expanded("platform.tilt", mountings) == tilt
    assert expanded("platform.drift", mountings) == tilt
    assert expanded("platform.g_sensitivity", mountings) == azimuth


def test_nothing_acts_on_a_vertical_input_axis():
    assert expanded("platform.tilt", {"Qz": QZ}) == (
        'model.terms[1]: no component of "platform.tilt" affects these accelerometers to first '
        "order; omit it, or give one component, such as platform.tilt.east"
    )


def test_gyro_terms_turn_with_the_platform():
    # x east, y up, z south: the azimuth gyro is y, and the gyro about north is -z.
    turned = attitude_rows("90 deg about east")
    assert expanded("platform.tilt", {"Qx": QX}, [turned]) == "north"
    assert expanded("platform.drift", {"Qx": QX}, [turned]) == "up"
    assert expanded("platform.g_sensitivity", {"Qx": QX}, [turned]) == "yx zz"
    assert expanded("platform.drift", {"Qx": QX}, [LEVEL, turned]) == "north up"


@pytest.mark.parametrize("attitude", ["level", "90 deg about east", "30 deg about north"])
@pytest.mark.parametrize("mounting", [QX, QY, QZ, OBLIQUE], ids=["Qx", "Qy", "Qz", "oblique"])
def test_tilts_that_act_are_those_through_which_gravity_leaks(mounting, attitude):
    rows = attitude_rows(attitude)
    gravity = np.array([0.0, 0.0, Site(9.8, 0.7).gravity])
    input_axis = mounting.matrix[0] @ rows
    for row in BARE_NAMES["platform.tilt"]:
        leak = -np.cross(np.eye(3)[row.effect.axis], gravity) @ input_axis  # -(psi x f)
        assert acts(row, mounting, rows) == (abs(leak) > 1e-6)


@pytest.mark.parametrize(
    ("symbol", "mounting", "reaches"),
    [("yz", QX, True), ("xz", QX, False), ("zz", QX, False), ("xz", QY, True), ("yz", QZ, False)],
)
def test_a_g_sensitivity_to_gravity_itself_reaches_as_a_drift_does(symbol, mounting, reaches):
    row = SHARED_TERMS[f"platform.g_sensitivity.{symbol}"]
    about = {"x": "east", "y": "north", "z": "up"}[symbol[0]]
    drift = SHARED_TERMS[f"platform.drift.{about}"]
    assert acts(row, mounting, LEVEL) == acts(drift, mounting, LEVEL) == reaches


def test_a_component_prior_overrides_that_of_the_bare_name():
    model, _, problems = resolve(
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
def test_a_component_prior_of_the_head_overrides_wider_ones_in_any_order(tmp_path, order):
    stated = [
        '"head.harmonic.1.sin" = "0 ± 3 arcsec"\n',
        '"head.harmonic.1" = "0 ± 2 arcsec"\n',
        '"head.harmonic" = "0 ± 1 arcsec"\n',
    ]
    read = (at_rest(f"{angle}", f"{angle} deg about north", "1 mA") for angle in (0, 60, 120))
    text = place() + ACCELEROMETER + "".join(["[model.priors]\n", *stated[::order], *read])
    priors = campaign_of(tmp_path, text).model.priors
    found = {symbol: round(prior.u / ARCSEC, 9) for symbol, prior in priors.items()}
    first = {"head.harmonic.1.cos": 2.0, "head.harmonic.1.sin": 3.0}
    others = {f"head.harmonic.{n}.{wave}": 1.0 for n in (2, 3, 4) for wave in ("cos", "sin")}
    assert found == {**first, **others}


def test_one_accelerometer_prior_overrides_that_of_all():
    _, priors, problems = resolve(
        {"Qx": QX, "Qy": QY},
        terms=["K_II"],
        hold=["K_OO"],
        priors={"Qx.K_OO": "1 ± 2 ug/g^2", "K_OO": "0 ± 1 ug/g^2"},
    )
    assert problems == []
    assert priors["Qx"] == {"K_OO": Quantity(1e-6, 2e-6, "g/g^2")}
    assert priors["Qy"] == {"K_OO": Quantity(0.0, 1e-6, "g/g^2")}


def test_keys_without_quotation_marks_nest_and_are_understood():
    model, priors, problems = resolve(
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


def test_held_terms_need_a_prior_for_every_accelerometer():
    given = {"Qx": {"K_OO": Quantity(0.0, 1e-6, "g/g^2")}}
    _, _, (problem,) = resolve({"Qx": QX, "Qy": QY}, given=given, terms=["K_II"], hold=["K_OO"])
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
def test_what_is_assumed_to_be_perfect(assume, taken, not_taken):
    model, _, problems = resolve({"Qx": QX}, terms=["K_II"], assume=assume)
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
def test_what_is_assumed_must_be_there(assume, problem):
    _, _, (told,) = resolve({"Qx": QX}, terms=["K_F"], assume=assume)
    assert told.endswith(problem)


@pytest.mark.parametrize("key", ["hold", "considered"])
@pytest.mark.parametrize("name", ["K_OO", "platform.tilt"])
def test_what_is_held_is_not_assumed(key, name):
    known = {"K_OO": "0 ± 1e-6 g/g^2", "platform.tilt": "0 ± 1 arcsec"}
    held = {"terms": ["K_II"], key: [name], "priors": known}
    _, _, (told,) = resolve({"Qx": QX}, assume=["K_PP", name], **held)
    assert told == f'model.assume[1]: "{name}" is also in model.{key}; keep only one of them'
    # Of a family only what is not stated is assumed.
    assert resolve({"Qx": QX}, assume="all", **held)[2] == []


def test_considered_is_the_old_name_of_hold():
    known = {"K_OO": "0 ± 1e-6 g/g^2", "K_PP": "0 ± 1e-6 g/g^2"}
    old, new = (
        resolve({"Qx": QX}, terms=["K_II"], priors=known, **{key: ["K_OO"]})
        for key in ("considered", "hold")
    )
    assert old == new
    assert new[0].considered == ("K_OO",)
    _, _, (told,) = resolve(
        {"Qx": QX}, terms=["K_II"], priors=known, hold=["K_OO"], considered=["K_PP"]
    )
    assert told == "model.considered: this key is the old name of hold; keep only hold"


def test_what_is_neither_asked_for_nor_held_may_have_a_prior():
    model, priors, problems = resolve(
        {"Qx": QX},
        terms=["K_II"],
        priors={"K_OO": "1 ± 2 ug/g^2", "platform.drift.up": "0 ± 0.01 deg/h"},
    )
    assert problems == []
    assert priors["Qx"] == {"K_OO": Quantity(1e-6, 2e-6, "g/g^2")}
    assert set(model.priors) == {"platform.drift.up"}
    assert model.considered == ()


def test_terms_must_name_an_accelerometer_coefficient():
    _, _, (problem,) = resolve({"Qx": QX}, terms=["platform.tilt"])
    assert problem == "model.terms: contains no accelerometer term to estimate"


def test_every_platform_term_has_a_bare_name():
    assert {row.symbol for rows in BARE_NAMES.values() for row in rows} == {
        symbol for symbol in SHARED_TERMS if symbol not in ("centrifuge.stretch", "table.lever_arm")
    }


def test_a_sensitivity_that_acts_leaves_a_mean_at_some_start_angle():
    """Against the closed form, which has start angle zero, and its quarter turn."""
    quarter = Mounting.from_axes("south", "down"), Mounting.from_axes("east", "down")
    for row in BARE_NAMES["platform.g_sensitivity"]:
        if row.effect.force_axis == 2:
            continue  # a drift, which leaves no mean but t^3
        for mounting, turned in zip((QX, QY), quarter, strict=True):
            # A quarter turn about up takes x to y: the same machine from another start angle.
            means = [
                parabola(symbol, axes, 1.7, 2.5, 9.8)
                for symbol, axes in ((row.symbol, mounting), (_quarter(row.symbol), turned))
            ]
            assert acts(row, mounting, LEVEL) == any(abs(mean) > 1e-9 for mean in means)
            meant = row in rows_of("platform.g_sensitivity", [mounting], [LEVEL])
            assert meant == (abs(means[0]) > 1e-9)


def _quarter(symbol):
    family, _, pair = symbol.rpartition(".")
    return f"{family}.{pair.translate(str.maketrans('xy', 'yx'))}"


def test_typical_sizes_may_be_changed():
    model, _, problems = resolve(
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


def test_sizes_of_every_row_of_the_table():
    """Those of inputs and of the machine too, a mounting's own among them."""
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
    model, _, problems = resolve({"Qx": QX}, terms=["K_II"], typical=written, limits=written)
    assert problems == []
    for symbol, (_, size) in sizes.items():
        assert model.typical[symbol] == pytest.approx(size, rel=1e-14)
        assert model.limits[symbol] == pytest.approx(size, rel=1e-14)
    assert set(model.typical) == set(model.limits) == set(sizes)
    _, _, (told,) = resolve({"Qx": QX}, terms=["K_II"], typical={"centrifuge.radios": "1 mm"})
    assert told.startswith('model.typical."centrifuge.radios": unknown term')


def test_names_of_the_path_mean_harmonics_and_their_quadratures():
    assert expanded("encoder.harmonic.3", {"Qx": QX}) == "cos sin"
    assert expanded("centrifuge.imbalance", {"Qx": QX}) == "1.cos 1.sin 2.cos 2.sin"
    model, _, problems = resolve(
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


def test_the_path_does_not_show_along_the_vertical():
    assert "no component" in expanded("encoder.harmonic", {"Qz": QZ})
    assert not acts(SHARED_TERMS["centrifuge.stretch"], QZ, LEVEL)
    assert acts(SHARED_TERMS["centrifuge.stretch"], QY, LEVEL)
