import importlib.resources
import math
import subprocess
import sys

import numpy as np
import pytest
from campaigns import PLACE, replace_parts
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.model import DEFAULT_TERMS
from counterspin.campaign.quantity import Quantity
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import TABLE, term
from counterspin.simulation.simulable import simulation_problems

BASE = (
    replace_parts(
        PLACE,
        ("[site]", '[campaign]\ntitle = "Test"\n\n[site]'),
        ('"9.8066 m/s^2"', '"9.8 ± 1e-5 m/s^2"'),
        ('"45.75 deg"', '"45 deg"'),
        ('"2.5 m"', '"2.5 ± 1e-5 m"'),
        ('unit = "s"', 'unit = "ms"'),
        ('"angle_rad", unit = "rad"', '"angle", unit = "deg"'),
    )
    + """
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 2e-6 g"
scale_factor = "1.002 ± 5e-6 g/g"
displacement = { column = "east_m", unit = "mm" }

[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
K_III = "0 ± 1e-5 g/g^3"
displacement = { column = "north_m", unit = "m" }

[noise]
displacement = "0.01 m"
acceleration = "1e-6 g/Hz^0.5"
timing = "estimate"

[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III"]
hold = []

[model.priors]

[[runs]]
name = "run1"
rate = "0.25 rev/s"
record = "run1.csv"

[[runs]]
name = "run2"
rate = "-180 deg/s"
record = "run2.parquet"
"""
)


def write_description(folder, text):
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


def edit(*changes):
    text = BASE
    for old, new in changes:
        assert text.count(old) >= 1, old
        text = text.replace(old, new, 1)
    return text


def test_sizes_follow_grade_of_accelerometer(tmp_path):
    text = edit(
        ("K_III =", 'grade = "consumer"\nK_III ='),
        ("[model.priors]", '[model.limits]\nK_OQ = "1 g/g^2"\n[model.priors]'),
    )
    campaign = read_campaign(write_description(tmp_path, text))
    assert [a.grade for a in campaign.accelerometers.values()] == ["navigation", "consumer"]
    for symbol in ("K_F", "K_II", "K_F.trend"):
        for name, grade in (("Qx", "navigation"), ("Qy", "consumer")):
            size = term(symbol).sizes(grade)
            assert campaign.limit_of(symbol, name) == size.limit
            assert campaign.typical_of(symbol, name) == size.typical
    # A stated size applies to all accelerometers, and shared terms have no grade.
    assert campaign.limit_of("K_OQ", "Qx") == campaign.limit_of("K_OQ", "Qy") == 1.0
    tilt = "platform.tilt.north"
    assert campaign.typical_of(tilt, "Qy") == campaign.typical_of(tilt) == term(tilt).typical


def test_scale_factor_prior_is_checked_against_grade(tmp_path):
    far = ('scale_factor = "1.002 ± 5e-6 g/g"', 'scale_factor = "1.3 ± 0.1 g/g"')
    (line,) = list_problems(tmp_path, edit(far))
    assert "nominal K_I, 1" in line
    consumer = ('bias = "0.005 ± 2e-6 g"', 'bias = "0.005 ± 2e-6 g"\ngrade = "consumer"')
    assert (
        read_campaign(write_description(tmp_path, edit(far, consumer)))
        .accelerometers["Qx"]
        .priors["K_I"]
    )
    shared = ("[model.priors]", '[model.priors]\nK_I = "1.3 ± 0.1 g/g"')
    alone = (far[0], "")
    assert "nominal K_I, 1" in "".join(list_problems(tmp_path, edit(shared, alone)))
    read_campaign(write_description(tmp_path, edit(shared, alone, consumer)))


def list_problems(folder, text):
    with pytest.raises(CampaignError) as caught:
        read_campaign(write_description(folder, text))
    return caught.value.problems


def test_quantities_are_resolved_to_si(tmp_path):
    campaign = read_campaign(write_description(tmp_path, BASE))
    assert campaign.title == "Test"
    assert campaign.folder == tmp_path
    assert campaign.path == tmp_path / "campaign.toml"
    assert campaign.site == Site(9.8, math.pi / 4)
    assert campaign.gravity == Quantity(9.8, 1e-5, "m/s^2")
    assert campaign.radius == Quantity(2.5, 1e-5, "m")
    assert (campaign.time.name, campaign.time.factor, campaign.time.unit) == (
        "time_s",
        1e-3,
        "ms",
    )
    assert campaign.angle.factor == pytest.approx(math.pi / 180, rel=1e-15)
    assert campaign.timing_offset is None
    assert list(campaign.accelerometers) == ["Qx", "Qy"]
    qx, qy = campaign.accelerometers.values()
    assert (qx.mounting, qy.mounting) == (QX, QY)
    assert (qx.observable, qx.channel.name, qx.channel.factor) == (
        "displacement",
        "east_m",
        1e-3,
    )
    assert qx.priors == {
        "K_F": Quantity(0.005, 2e-6, "g"),
        "K_I": Quantity(1.002, 5e-6, "g/g"),
    }
    assert qy.priors == {"K_III": Quantity(0.0, 1e-5, "g/g^3")}
    assert campaign.noise.displacement == 0.01
    assert campaign.noise.acceleration == pytest.approx(9.8e-6, rel=1e-15)
    assert campaign.noise.timing == "estimate"
    assert campaign.noise.angle == 0.0
    assert campaign.model.terms == ("K_F", "K_I", "K_II", "K_III")
    assert campaign.model.limits == {}
    for symbol, row in TABLE.items():
        assert (campaign.limit_of(symbol), campaign.typical_of(symbol)) == (row.limit, row.typical)
    first, second = campaign.runs
    assert (first.name, first.rate) == ("run1", pytest.approx(math.pi / 2, rel=1e-15))
    assert (second.record, second.rate) == (
        tmp_path / "run2.parquet",
        pytest.approx(-math.pi, rel=1e-15),
    )
    assert np.array_equal(first.attitude, np.eye(3))
    assert campaign.simulation is first.truth is first.duration is None


def test_file_and_folder_read_alike(tmp_path):
    folder = write_description(tmp_path, BASE)
    assert read_campaign(str(folder / "campaign.toml")).title == read_campaign(folder).title


def test_missing_sections_have_defaults(tmp_path):
    text = BASE[: BASE.index("[noise]")] + BASE[BASE.index("[[runs]]") :]
    text = text.replace('[campaign]\ntitle = "Test"', "")
    text = text.replace('angle = { column = "angle", unit = "deg" }', "")
    campaign = read_campaign(write_description(tmp_path, text))
    assert campaign.noise is None
    assert campaign.model.terms == DEFAULT_TERMS
    assert campaign.angle is None
    assert campaign.title == tmp_path.name
    assert campaign.details == {}


def test_campaign_details_are_read(tmp_path):
    text = edit(('title = "Test"', 'title = "T"\ndate = 2024-05-17\noperator = "N. N."'))
    details = read_campaign(write_description(tmp_path, text)).details
    assert details == {"date": "2024-05-17", "operator": "N. N."}


def test_byte_order_mark_is_ignored(tmp_path):
    (tmp_path / "campaign.toml").write_text(BASE, encoding="utf-8-sig")
    assert read_campaign(tmp_path).title == "Test"


def test_specific_force_in_g_is_converted_with_site_gravity(tmp_path):
    text = edit(
        ('displacement = { column = "east_m", unit = "mm" }', FORCE),
        ('displacement = "0.01 m"', 'displacement = "0.01 m"\nspecific_force = "2 ug"'),
    )
    campaign = read_campaign(write_description(tmp_path, text))
    assert campaign.accelerometers["Qx"].observable == "specific_force"
    assert campaign.accelerometers["Qx"].channel.factor == pytest.approx(9.8, rel=1e-15)
    assert campaign.noise.specific_force == pytest.approx(2e-6 * 9.8, rel=1e-15)


FORCE = 'specific_force = { column = "f_x", unit = "g" }'
QX_DISPLACEMENT = 'displacement = { column = "east_m", unit = "mm" }'
EXACT_PATHS = [
    # (old text, new text, the only problem reported)
    ("schema = 1", "", "schema: is missing"),
    ("schema = 1", "schema = 2", "schema: this version of counterspin supports schema = 1"),
    ("schema = 1", "schema = true", "schema: this version of counterspin supports schema = 1"),
    ("schema = 1", "schema = 1.0", "schema: this version of counterspin supports schema = 1"),
    ("[noise]", "[noize]", 'noize: unknown key; did you mean "noise"?'),
    ('title = "Test"', 'titel = "x"', 'campaign.titel: unknown key; did you mean "title"?'),
    ("latitude =", "lattitude =", 'site.lattitude: unknown key; did you mean "latitude"?'),
    ('latitude = "45 deg"', "", "site.latitude: is missing"),
    ('"45 deg"', '"91 deg"', "site.latitude: a latitude must be between -90 deg and 90 deg"),
    ('"45 deg"', "48.1", 'site.latitude: has no unit; write "48.1 deg" (an angle:'),
    ('"9.8 ± 1e-5 m/s^2"', "9.8", 'site.gravity: has no unit; write "9.8 m/s^2"'),
    ('"9.8 ± 1e-5 m/s^2"', '"-9.8 m/s^2"', "site.gravity: must be greater than zero"),
    (
        '"9.8 ± 1e-5 m/s^2"',
        '"980 m/s^2"',
        "site.gravity: 980 m/s^2 is not a possible value of gravity on Earth",
    ),
    ('"2.5 ± 1e-5 m"', '"0 m"', "centrifuge.radius: must be greater than zero"),
    ('"2.5 ± 1e-5 m"', '"-2.5 m"', "centrifuge.radius: must be greater than zero"),
    ('"2.5 ± 1e-5 m"', '"2.5"', "centrifuge.radius: '2.5' has no unit; a length is required"),
    ('"2.5 ± 1e-5 m"', '"2.5 s"', "centrifuge.radius: 's' is not a unit of length; use m,"),
    ('"2.5 ± 1e-5 m"', '"nan m"', "centrifuge.radius: 'nan m' is not a finite number"),
    ('"2.5 ± 1e-5 m"', "inf", "centrifuge.radius: inf is not a finite number"),
    ('"2.5 ± 1e-5 m"', '"2.5 ± inf m"', "centrifuge.radius: '2.5 ± inf m' is not a finite"),
    ('unit = "ms"', 'unit = "m"', "records.time.unit: 'm' is not a unit of time; use s,"),
    ('unit = "deg"', 'unit = "grad"', "records.angle.unit: unknown unit 'grad'; an angle is"),
    (
        '"angle", ',
        '"angle", skip = 1, ',
        "records.angle.skip: unknown key; known: column,",
    ),
    ('"angle", ', '"time_s", ', 'records.angle: column "time_s" is already used by records.time'),
    ('"east"', '"eest"', 'accelerometers.Qx.input_axis: unknown direction "eest"; did you'),
    ('"east"', "[1, 0]", "accelerometers.Qx.input_axis: a direction must have three finite"),
    ('"east"', "[nan, 0, 1]", "accelerometers.Qx.input_axis: a direction must have three finite"),
    ('"east"', "[0, 0, 0]", "accelerometers.Qx.input_axis: a direction must have three finite"),
    ('"east"', "3", "accelerometers.Qx.input_axis: must be one of east, west"),
    ('"east"', '[1, 0, "x"]', "accelerometers.Qx.input_axis: must be one of east, west"),
    ('"down"', '"west"', "accelerometers.Qx: input and pendulous axes must be at right angles"),
    ('"down"', '"down"\noutput_axis = "south"', "accelerometers.Qx: the axes are left-handed"),
    ('"down"', '"down"\noutput_axis = "up"', "accelerometers.Qx: the output axis must be at"),
    ("bias =", "bies =", 'accelerometers.Qx.bies: unknown key; did you mean "bias"?'),
    ('"0.005 ± 2e-6 g"', '"5 m"', "accelerometers.Qx.bias: 'm' is not a unit of specific force"),
    ('"0.005 ± 2e-6 g"', '"5 ± -1 mg"', "accelerometers.Qx.bias: '5 ± -1 mg' has a negative"),
    (
        '"1.002 ± 5e-6 g/g"',
        '"1000 ppm"',
        "accelerometers.Qx.scale_factor: 0.001 g/g is too far from the nominal K_I, 1; write an "
        "error of 1000 ppm as 1.001 g/g",
    ),
    (
        "K_III =",
        'K_I = "0 ± 1e-3 g/g"\nK_III =',
        "accelerometers.Qy.K_I: 0 g/g is too far from the nominal K_I, 1",
    ),
    ("[model.priors]", '[model.priors]\n"Qx.K_I" = "1.2 g/g"', 'model.priors."Qx.K_I": 1.2 g/g is'),
    (
        "[model.priors]",
        '[model.priors]\nK_I = "-1 g/g"',
        "model.priors.K_I: -1 g/g is too far from the nominal K_I, 1",
    ),
    ("bias =", 'K_F = "0 g"\nbias =', "accelerometers.Qx.bias: duplicates the prior of K_F"),
    (QX_DISPLACEMENT, "", "accelerometers.Qx: has no recorded signal; give one of displacement,"),
    (QX_DISPLACEMENT, f"{QX_DISPLACEMENT}\n{FORCE}", "accelerometers.Qx: has displacement and"),
    ("[accelerometers.Qx]", "[accelerometers.noise]", "accelerometers.noise: cannot be the name"),
    ("0.01 m", "0.01 s", "noise.displacement: 's' is not a unit of length"),
    ("0.01 m", "-0.01 m", "noise.displacement: a standard deviation cannot be negative"),
    ("0.01 m", "1 ± 1 m", "noise.displacement: '1 ± 1 m': this entry must not have an uncertainty"),
    ("[noise]", '[noise]\nvelocity = "1 m/s"', "noise.velocity: no accelerometer has velo"),
    ('"K_III"]', '"K_IIII"]', 'model.terms[3]: unknown term "K_IIII"; did you mean "K_III"'),
    ('"K_III"]', '"zzz"]', 'model.terms[3]: unknown term "zzz"; known: K_F, K_I,'),
    ('"K_III"]', '"K_F"]', 'model.terms[3]: "K_F" is listed twice'),
    ('"K_III"]', "3]", "model.terms[3]: must be a string"),
    ("hold = []", 'hold = ["K_II"]', 'model.hold: "K_II" is also in model.terms'),
    ("hold = []", 'hold = ["K_OO"]', 'model.hold: "K_OO" is held, but'),
    ("hold = []", 'hold = ["platform.tilt"]', 'model.hold: "platform.tilt.eas'),
    ("[model.priors]", '[model.priors]\nK_II = "1 g"', "model.priors.K_II: 'g' is not a unit of"),
    ("[model.priors]", "[model.priors]\nK_II = 1", "model.priors.K_II: has no"),
    ("[model.priors]", '[model.priors]\nK_Q = "1 g"', 'model.priors.K_Q: unknown term "K_Q"'),
    ("[model.priors]", '[model.priors]\nK_OO = "0 g"', "model.priors.K_OO: 'g' is not a unit of"),
    (
        'assume = "all"',
        'assume = "al"',
        'model.assume[0]: unknown term "al"; did you mean "all"?',
    ),
    ('assume = "all"', 'assume = ["K_OOO"]', 'model.assume[0]: unknown term "K_OOO"; did you'),
    ('assume = "all"', "assume = 3", "model.assume: must be a list"),
    (
        "[model.priors]",
        '[model.priors]\nK_F = "0 ± 1 g"',
        "model.priors.K_F: a prior for K_F is also given",
    ),
    (
        "[model.priors]",
        '[model.priors]\n"Qx.K_I" = "1 ± 1 g/g"',
        'model.priors."Qx.K_I": a prior for K_I is also given in accelerometers.Qx; keep only one',
    ),
    (
        "[model.priors]",
        '[model.limits]\nK_II = "0 g/g^2"',
        "model.limits.K_II: must be greater than zero",
    ),
    ("[model.priors]", "[model.priors]\nK_IO = {}", "model.priors.K_IO: has no keys; give value"),
    ("[model.priors]", '[model.limits]\nK = "1 g"', 'model.limits.K: unknown term "K"'),
    (
        "K_III =",
        'grade = "strategic"\nK_III =',
        "accelerometers.Qy.grade: 'strategic' is not one of 'navigation', 'tactical' or 'consumer'",
    ),
    ("0.25 rev/s", "0.25 Hz", "runs[0].rate: 'Hz' is ambiguous for an angular rate: write rev/s"),
    ("0.25 rev/s", "0 rev/s", "runs[0].rate: is zero, but the centrifuge must rotate"),
    ("0.25 rev/s", "0.25 m", "runs[0].rate: 'm' is not a unit of angular rate"),
    ('"0.25 rev/s"', "0.25", 'runs[0].rate: has no unit; write "0.25 rad/s"'),
    ("0.25 rev/s", "0 ± 1 rpm", "runs[0].rate: is zero, but the centrifuge must rotate"),
    ('"run2"', '"run1"', 'runs[1].name: runs[0] already uses "run1"'),
    ("run2.parquet", "run1.csv", 'runs[1].record: runs[0] already uses "run1.csv"'),
    (
        "run2.parquet",
        "run2.doc",
        (
            'runs[1].record: "run2.doc" does not have a supported file type; the '
            "name of a record file must end in .csv,"
        ),
    ),
    ('"run2"', '""', "runs[1].name: must not be empty"),
    (
        '"run1.csv"',
        r'"data\new\table.csv"',
        r"runs[0].record: 'data\new\table.csv' contains a line break, a tab or another",
    ),
    ('record = "run1.csv"', "", 'runs[0].record: is missing (run "run1")'),
    ("run1.csv", 'run1.csv"\nattitude = "tilted', "runs[0].attitude: is not an attitude; write"),
    ("run1.csv", 'run1.csv"\nattitude = "5 m about up', "runs[0].attitude: 'm' is not a unit of"),
    ("run1.csv", 'run1.csv"\ntruth = {drift = "1 1/s"}#', "runs[0].truth: requires [simulation]"),
]


@pytest.mark.parametrize(("old", "new", "message"), EXACT_PATHS, ids=range(len(EXACT_PATHS)))
def test_error_names_key_path(tmp_path, old, new, message):
    problems = list_problems(tmp_path, edit((old, new)))
    assert any(problem.startswith(message) for problem in problems), problems


def test_error_names_run_and_index(tmp_path):
    problems = list_problems(tmp_path, edit(("-180 deg/s", "3 Hz")))
    assert problems[0].startswith("runs[1].rate: ")
    assert problems[0].endswith('(run "run2")')


def test_all_errors_are_reported_together(tmp_path):
    text = edit(
        ('"9.8 ± 1e-5 m/s^2"', '"9.8 s"'),
        ('"2.5 ± 1e-5 m"', '"-1 m"'),
        ('"angle", ', '"time_s", '),
        ('"down"', '"west"'),
        ('"0.005 ± 2e-6 g"', "0.005"),
        ('"K_III"]', '"K_IV"]'),
        ('"run2"', '"run1"'),
        ("0.25 rev/s", "0.25 Hz"),
        ("run2.parquet", "run2.doc"),
    )
    problems = list_problems(tmp_path, text)
    paths = [problem.split(":")[0] for problem in problems]
    assert sorted(paths) == sorted(
        [
            "site.gravity",
            "centrifuge.radius",
            "records.angle",
            "accelerometers.Qx",
            "accelerometers.Qx.bias",
            "model.terms[3]",
            "runs[0].rate",
            "runs[1].name",
            "runs[1].record",
        ]
    )


@pytest.mark.parametrize(
    ("start", "end", "message"),
    [
        ("[accelerometers.Qx]", "[noise]", "accelerometers: is missing"),
        ("[[runs]]", None, "runs: is missing"),
        ("[site]", "[centrifuge]", "site: is missing"),
        ("[centrifuge]", "[records]", "centrifuge: is missing"),
        ("[records]", "[accelerometers.Qx]", "records: is missing"),
    ],
)
def test_missing_section_is_named(tmp_path, start, end, message):
    cut = BASE[: BASE.index(start)] + (BASE[BASE.index(end) :] if end else "")
    assert list_problems(tmp_path, cut) == (message,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("runs = []\naccelerometers = {}", "runs: must have at least one entry"),
        ("runs = []\naccelerometers = {}", "accelerometers: must have at least one entry"),
        ("runs = 3", "runs: must be a list"),
        ("runs = [3]", "runs[0]: must be a table"),
        ("site = 3", "site: must be a table"),
        ("accelerometers = { Qx = 3 }", "accelerometers.Qx: must be a table"),
    ],
)
def test_wrong_structure_is_reported(tmp_path, text, message):
    assert message in list_problems(tmp_path, text)


def test_missing_file_error_suggests_init(tmp_path):
    with pytest.raises(CampaignError, match="file not found; `counterspin init DIR` creates"):
        read_campaign(tmp_path)
    with pytest.raises(CampaignError, match=r"other\.toml: file not found"):
        read_campaign(tmp_path / "other.toml")


def test_toml_error_states_line(tmp_path):
    text = edit(('"2.5 ± 1e-5 m"', "2.5 m"))
    line = text[: text.index("2.5 m")].count("\n") + 1
    with pytest.raises(CampaignError, match=rf"campaign.toml: line {line}, column \d+: more text"):
        read_campaign(write_description(tmp_path, text))


@pytest.mark.parametrize("name", [r"C:\data\run1.csv", r"C:\Units\x.csv", r"D:\x.csv"])
def test_windows_path_in_double_quotes_is_explained(tmp_path, name):
    (problem,) = list_problems(tmp_path, edit(("run1.csv", name)))
    assert problem.startswith("line ")
    assert r"write paths with /, or in single quotation marks, 'C:\data\run1.csv'" in problem


def test_rejects_other_text_encoding(tmp_path):
    (tmp_path / "campaign.toml").write_bytes(BASE.encode("latin-1"))
    with pytest.raises(CampaignError, match="is not UTF-8 text"):
        read_campaign(tmp_path)


def test_prior_without_uncertainty_is_exact(tmp_path):
    text = edit(('"0.005 ± 2e-6 g"', '"0.049 m/s^2"'))
    prior = read_campaign(write_description(tmp_path, text)).accelerometers["Qx"].priors["K_F"]
    assert prior.value == pytest.approx(0.005, rel=1e-14)
    assert prior.u == 0.0


def test_attitudes_are_parsed(tmp_path):
    text = edit(
        ('"run1.csv"', '"run1.csv"\nattitude = "90 deg about east"'),
        ('"run2.parquet"', '"run2.mat"\nattitude = { x = "up", y = [0, 2, 0] }'),
    )
    first, second = read_campaign(write_description(tmp_path, text)).runs
    east, north, up = np.eye(3)
    assert np.array_equal(first.attitude, [east, up, -north])
    assert np.array_equal(second.attitude, [up, north, -east])


@pytest.mark.parametrize(
    ("attitude", "message"),
    [
        ('{ x = "east", y = "west" }', "the axes x and y must be at right angles"),
        ('{ x = "east", y = "north", z = "down" }', "the axes are left-handed"),
        ('{ x = "east", y = "north", z = "east" }', "the axis z must be at right angles"),
        ('{ x = "east" }', "is not an attitude"),
        ('"1 ± 1 deg about up"', "an attitude must not have an uncertainty here"),
        ('"1 deg about noon"', 'unknown direction "noon"'),
    ],
)
def test_rejects_invalid_attitudes(tmp_path, attitude, message):
    text = edit(('"run1.csv"', f'"run1.csv"\nattitude = {attitude}'))
    (problem,) = list_problems(tmp_path, text)
    assert problem.startswith(f"runs[0].attitude: {message}")


SIMULATED = """
[simulation]
sampling_rate = "20 Hz"
seed = 7
revolutions = 10

[truth.Qx]
K_II = "20 ug/g^2"
delta_O = "1 mrad"
start_offset = "1 mm"

[truth.spindle]
drift = "1e-6 1/s"
ripple = [{ ratio = 1e-5, phase = "90 deg" }, { harmonic = 3, amplitude = "1e-6 rad/s" }]

[truth.platform]
tilt.north = "1 arcsec"
drift.north = "0.01 deg/h"
g_sensitivity.zx = "0.02 deg/h/g"

[truth.noise]
displacement = "1 mm"
"""


def test_simulation_truth_is_read(tmp_path):
    own = (
        '"run2.parquet"\nduration = "1 min"\ntruth = { drift = "2e-6 1/s", ripple = [], '
        'rate_error = "100 ppm", start_angle = "90 deg", tilt = { north = "2 arcsec" } }'
    )
    text = edit(('"run2.parquet"', own)) + SIMULATED
    campaign = read_campaign(write_description(tmp_path, text))
    simulation = campaign.simulation
    assert (simulation.sampling_rate, simulation.seed) == (20.0, 7)
    truth = simulation.truth
    assert truth.coefficients["Qx"] == pytest.approx({"K_II": 2e-5, "delta_O": 1e-3}, rel=1e-15)
    assert truth.coefficients["Qy"] == {}
    assert truth.start_offset == {"Qx": 1e-3, "Qy": 0.0}
    assert truth.start_velocity == {"Qx": 0.0, "Qy": 0.0}
    assert vars(truth.noise) == {**dict.fromkeys(vars(truth.noise), 0.0), "displacement": 1e-3}
    first, second = campaign.runs
    assert (first.duration, second.duration) == (pytest.approx(40.0, rel=1e-14), 60.0)
    rate = first.rate
    of_one, of_two = truth.runs.values()
    assert of_one.spindle == Spindle(
        rate, 1e-6, (Ripple(1, 1e-5 * rate, math.pi / 2), Ripple(3, 1e-6, 0.0))
    )
    assert of_two.spindle == Spindle(
        pytest.approx(-math.pi * 1.0001, rel=1e-15), 2e-6, (), math.pi / 2
    )
    arcsec = math.pi / 648000
    assert of_one.shared == pytest.approx(
        {
            "platform.tilt.north": arcsec,
            "platform.drift.north": 0.01 * arcsec,
            "platform.g_sensitivity.zx": 0.02 * arcsec,
        },
        rel=1e-14,
    )
    assert of_two.shared["platform.tilt.north"] == pytest.approx(2 * arcsec, rel=1e-14)


def test_truth_does_not_change_calibration_inputs(tmp_path):
    plain = read_campaign(write_description(tmp_path, BASE))
    with_truth = read_campaign(write_description(tmp_path, BASE + SIMULATED))
    apart = {"runs", "simulation", "source"}
    for name in set(vars(plain)) - apart:
        assert getattr(plain, name) == getattr(with_truth, name), name
    for first, second in zip(plain.runs, with_truth.runs, strict=True):
        assert (first.name, first.rate, first.record) == (second.name, second.rate, second.record)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[truth.Qx]",
            "[truth.Qxx]",
            "truth.Qxx: is neither an accelerometer nor a known table; did",
        ),
        ("K_II =", "K_2 =", 'truth.Qx.K_2: unknown key; did you mean "K_I'),
        ('"20 ug/g^2"', '"20 ± 1 ug/g^2"', "truth.Qx.K_II: '20 ± 1 ug/g^2': this entry must not"),
        ('"20 ug/g^2"', '"20 ug"', "truth.Qx.K_II: 'ug' is not a unit of second-order"),
        ("tilt.north", "tilt.nord", 'truth.platform.tilt.nord: unknown key; did you mean "north"?'),
        ("tilt.north", "tild.north", 'truth.platform.tild: unknown key; did you mean "tilt"?'),
        ('"1 arcsec"', "nan", "truth.platform.tilt.north: nan is not a finite number"),
        ("ratio = 1e-5, ", "", "truth.spindle: give each ripple either a ratio w_n/w0 or an"),
        ("ratio = 1e-5", "ratio = nan", "truth.spindle.ripple[0].ratio: must be a finite number"),
        ("ratio = 1e-5", "size = 1", "truth.spindle.ripple[0].size: unknown key; known: harmonic,"),
        ("harmonic = 3", "harmonic = 0", "truth.spindle.ripple[1].harmonic: must be greater"),
        ('drift = "1e-6', 'rate_error = -1\ndrift = "1e-6', "truth.spindle.rate_error: is relat"),
        ('"20 Hz"', '"20 m"', "simulation.sampling_rate: 'm' is not a unit of frequency"),
        ("seed = 7", "seed = 7.5", "simulation.seed: "),
        ("revolutions = 10", "revolutions = 0", "simulation.revolutions: must be greater than"),
        ("[truth.noise]", "[truth.Qy]", "truth.Qy.displacement: unknown key"),
        ('"1 mm"\n\n[truth.s', '"1 s"\n\n[truth.s', "truth.Qx.start_offset: 's' is not a unit of"),
    ],
)
def test_errors_in_truth_are_named(tmp_path, old, new, message):
    assert old in SIMULATED
    problems = list_problems(tmp_path, BASE + SIMULATED.replace(old, new, 1))
    assert any(problem.startswith(message) for problem in problems), problems


def test_simulation_requires_true_size_of_estimated_noise(tmp_path):
    text = BASE + SIMULATED[: SIMULATED.index("[truth.noise]")]
    campaign = read_campaign(write_description(tmp_path, text))
    assert campaign.noise.timing == "estimate"
    (problem,) = simulation_problems(campaign)
    assert (
        problem == "noise.timing: a simulation requires the true value; write it in [truth.noise]"
    )
    text = BASE + SIMULATED.replace('displacement = "1 mm"', 'timing = "estimate"')
    (problem,) = simulation_problems(read_campaign(write_description(tmp_path, text)))
    assert problem == "truth.noise.timing: a simulation requires the true value"
    assert simulation_problems(read_campaign(write_description(tmp_path, BASE + SIMULATED))) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "20 ug/g^2",
            "2 g/g^2",
            "truth.Qx.K_II: 2 g/g^2 is more than 5 times the largest",
        ),
        ('"1 mrad"', '"1 rad"', "truth.Qx.delta_O: 1 rad is more than 5 times the largest"),
        ('K_II = "20 ug/g^2"', 'K_I = "1000 ppm"', "truth.Qx.K_I: 0.001 g/g is more than 5 times"),
        ('"1 arcsec"', '"90 deg"', 'truth of runs[0] ("run1"), platform.tilt.north: 1.5708 rad is'),
        ('"0.01 deg/h"', '"1 deg/s"', 'truth of runs[0] ("run1"), platform.drift.north: '),
        ("harmonic = 3", "harmonic = 1000000", 'truth of runs[0] ("run1"): harmonic '),
        ("ratio = 1e-5", "ratio = 0.6", 'truth of runs[0] ("run1"): ripple and drift change the '),
        ('"1e-6 1/s"', '"1e-1 1/s"', 'truth of runs[0] ("run1"): ripple and drift change the rate'),
    ],
)
def test_rejects_incredible_truth(tmp_path, old, new, message):
    assert old in SIMULATED
    text = BASE + SIMULATED.replace(old, new, 1)
    problems = simulation_problems(read_campaign(write_description(tmp_path, text)))
    assert problems
    assert problems[0].startswith(message), problems


def test_campaign_limits_permit_larger_truth(tmp_path):
    text = edit(("[model.priors]", '[model.limits]\nK_II = "1 g/g^2"\n[model.priors]'))
    text += SIMULATED.replace("20 ug/g^2", "2 g/g^2")
    assert simulation_problems(read_campaign(write_description(tmp_path, text))) == []


def test_starter_is_valid_and_truth_agrees_with_priors(tmp_path):
    starter = importlib.resources.files("counterspin.ingest") / "starter.toml"
    campaign = read_campaign(write_description(tmp_path, starter.read_text(encoding="utf-8")))
    truth = campaign.simulation.truth
    for name, accelerometer in campaign.accelerometers.items():
        for symbol, prior in accelerometer.priors.items():
            assert abs(truth.coefficients[name][symbol] - prior.value) < 2.0 * prior.u
    assert [run.duration for run in campaign.runs] == pytest.approx([400.0, 200.0, 100.0])
    assert truth.noise.displacement == campaign.noise.displacement
    assert campaign.details == {}


def test_reading_campaign_does_not_import_heavy_packages(tmp_path):
    write_description(tmp_path, BASE)
    code = (
        "import sys; from counterspin.campaign.description import read_campaign; "
        f"read_campaign({str(tmp_path)!r}); "
        "heavy = {'matplotlib', 'dask', 'scipy.stats', 'polars', 'h5py'} & set(sys.modules); "
        "sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_record_given_as_campaign_raises(tmp_path):
    with pytest.raises(CampaignError, match=r"run1\.csv: file not found"):
        read_campaign(tmp_path / "run1.csv")
    (tmp_path / "run1.csv").touch()
    with raises("wrong-document", "run1.csv:"):
        read_campaign(tmp_path / "run1.csv")


# --- errors of the path ---------------------------------------------------------------------------


def test_stretch_can_be_prior_requested_or_omitted(tmp_path):
    stretched = ('radius = "2.5 ± 1e-5 m"', 'radius = "2.5 ± 1e-5 m"\nstretch = "0 ± 5e-9 s^2/m"')
    model = read_campaign(write_description(tmp_path, edit(stretched))).model
    assert "centrifuge.stretch" not in (*model.terms, *model.considered)
    assert model.priors["centrifuge.stretch"].u == 5e-9
    texts = ('"K_III"]', '"K_III", "centrifuge.stretch"]')
    model = read_campaign(write_description(tmp_path, edit(stretched, texts))).model
    assert model.considered == ()
    assert model.terms[-1] == "centrifuge.stretch"
    twice = ("[model.priors]", '[model.priors]\n"centrifuge.stretch" = "0 ± 1e-9 s^2/m"')
    (problem,) = list_problems(tmp_path, edit(stretched, texts, twice))
    assert problem.startswith('model.priors."centrifuge.stretch": is also given in [centrifuge]')


@pytest.mark.parametrize(
    ("key", "symbol", "strapped", "message"),
    [
        ("terms", "table.harmonic.1", False, "is an error of the counter-rotating table; if"),
        ("hold", "table.harmonic.2", False, "is an error of the counter-rotating table; if"),
        ("priors", "table.harmonic.1.cos", False, "is an error of the counter-rotating table; if"),
        ("terms", "platform.drift.north", True, "is an error of the platform gyros; acc"),
        ("terms", "table.harmonic.1", True, ""),
        ("terms", "platform.tilt.north", True, ""),
    ],
)
def test_terms_without_effect_are_named(tmp_path, key, symbol, strapped, message):
    changes = [('radius = "2.5 ± 1e-5 m"', 'radius = "2.5 ± 1e-5 m"\nstrapped = true')] * strapped
    if key == "terms":
        changes.append(('"K_III"]', f'"K_III", "{symbol}"]'))
    else:
        prior = f'"{symbol}" = "0 ± 1 arcsec"'
        changes.append(("[model.priors]", f"[model.priors]\n{prior}"))
    if key == "hold":
        changes.append(("hold = []", f'hold = ["{symbol}"]'))
    if not message:
        assert (
            read_campaign(write_description(tmp_path, edit(*changes)))
            .model.terms[4]
            .startswith(symbol)
        )
        return
    first = list_problems(tmp_path, edit(*changes))[0]
    assert first.startswith(f'model.{key}: "{symbol}')
    assert message in first


def test_encoder_errors_require_recorded_angle(tmp_path):
    texts = ('"K_III"]', '"K_III", "encoder.harmonic.1"]')
    unrecorded = ('angle = { column = "angle", unit = "deg" }', "")
    (problem,) = list_problems(tmp_path, edit(texts, unrecorded))
    assert problem == "model.terms: contains encoder errors, but no angle is recorded"
    assert read_campaign(write_description(tmp_path, edit(texts))).model.terms[-2:] == (
        "encoder.harmonic.1.cos",
        "encoder.harmonic.1.sin",
    )


def test_truth_of_path_errors_is_read(tmp_path):
    tables = '[truth.centrifuge]\nstretch = "4e-9 s^2/m"\nimbalance.2.sin = "3 um"\n'
    tables += '[truth.encoder]\nharmonic.1.cos = "1 arcsec"\n'
    campaign = read_campaign(write_description(tmp_path, f"{BASE}{SIMULATED}\n{tables}"))
    (first, _) = campaign.simulation.truth.runs.values()
    assert first.shared["centrifuge.stretch"] == 4e-9
    assert first.shared["centrifuge.imbalance.2.sin"] == pytest.approx(3e-6, rel=1e-14)
    assert first.shared["encoder.harmonic.1.cos"] == pytest.approx(math.radians(1 / 3600))
    wrong = tables.replace("imbalance.2", "imbalance.3")
    (problem,) = list_problems(tmp_path, f"{BASE}{SIMULATED}\n{wrong}")
    assert problem.startswith("truth.centrifuge.imbalance.3: unknown key")
