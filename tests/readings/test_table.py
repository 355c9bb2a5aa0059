"""Tables of readings: they say the same as runs; each slip is one message with its line."""

import math
from dataclasses import replace

import polars as pl
import pytest
from raising import raises
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site
from workbooks import write_workbook

from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError

HEAD = format_site("1.0 m") + ACCELEROMETER
RUN = format_rest_run("tumble 30", "30 deg about north", "1.082532 ± 2e-6 mA")
SIMPLE = 'columns = { attitude = "angle", reading = "mA" }'


def read(folder, text):
    (folder / "campaign.toml").write_text(HEAD + text, encoding="utf-8")
    return read_campaign(folder)


def read_csv_table(folder, content, keys=SIMPLE):
    (folder / "r.csv").write_text(content, encoding="utf-8")
    return read(folder, f'[readings]\nfile = "r.csv"\n{keys}\n').readings


def read_problems(folder, content, keys=SIMPLE):
    with pytest.raises(CampaignError) as caught:
        read_csv_table(folder, content, keys)
    return caught.value.problems


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".xlsx"])
def test_table_equals_runs(tmp_path, suffix):
    columns = {"p": ["tumble 30"], "deg": [30], "mA": [1.082532], "u": [2e-6]}
    if suffix == ".csv":
        pl.DataFrame(columns).write_csv(tmp_path / "readings.csv")
    elif suffix == ".parquet":
        pl.DataFrame(columns).write_parquet(tmp_path / "readings.parquet")
    else:
        rows = [list(columns), [column[0] for column in columns.values()]]
        write_workbook(tmp_path / "readings.xlsx", {"Notes": [], "Tumble": rows})
    table = f"""[readings]
file = "readings{suffix}"
columns = {{ name = "p", attitude = "deg", reading = "mA", u = "u" }}
"""
    if suffix == ".xlsx":
        table += 'sheet = "Tumble"\n'
    (reading,) = read(tmp_path, table).readings
    (written,) = read(tmp_path, RUN).readings
    assert reading == written


def test_table_of_arm_readings_has_mounting_axes(tmp_path):
    keys = """motion = "arm"
rate_unit = "rpm"
columns = { rate = "n", input = "side", pendulous = "below", mounting = "side", reading = "mA" }
"""
    first, second = read_csv_table(
        tmp_path, "n;side;below;mA\n60;inward;up;5\n-60;outward;up;-5\n", keys
    )
    assert (first.rate, second.rate) == (
        pytest.approx(2.0 * math.pi),
        pytest.approx(-2.0 * math.pi),
    )
    assert (first.mounting, second.mounting) == ("inward", "outward")
    assert second.axes.axes[:2] == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


ARM = """motion = "arm"
columns = { rate = "n", mounting = "side", reading = "mA" }
axes_at_rest = { input = "up", pendulous = "outward" }
[readings.mountings]
innen = { input = "inward", pendulous = "up" }
hinten = { input = "backward", pendulous = "inward" }
"""


def test_zero_rate_is_reading_at_rest(tmp_path):
    table = "n,side,mA\n6,innen,5\n0,innen,0\n0,,1.25\n0,hinten,0\n"
    turning, inward, upright, backward = read_csv_table(tmp_path, table, ARM)
    assert (turning.motion, turning.mounting, turning.rate) == ("arm", "innen", 6.0)
    assert turning.axes.axes[:2] == ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    # At rest the axes are east, north and up: those of an arm that points east.
    assert (inward.motion, inward.mounting, inward.rate) == ("static", "innen", 0.0)
    assert inward.axes.axes[:2] == ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert (upright.motion, upright.mounting) == ("static", "")
    assert upright.axes.axes[:2] == ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert backward.axes.axes[:2] == ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0))


BESIDE = """motion = "arm"
columns = { rate = "n", u = "u" }
[readings.mountings]
in = { input = "inward", pendulous = "up", reading = "plus" }
out = { input = "outward", pendulous = "up", reading = "minus" }
"""


def test_mounting_columns_are_separate_readings(tmp_path):
    beside = read_csv_table(tmp_path, "n,plus,minus,u\n6,5,-5,2e-6\n0,1e-3,,2e-6\n", BESIDE)
    assert [one.name for one in beside] == ["reading 1, in", "reading 1, out", "reading 2, in"]
    below = BESIDE.replace(', reading = "plus"', "").replace(', reading = "minus"', "")
    below = below.replace("columns = {", 'columns = { name = "no", mounting = "w", reading = "mA",')
    rows = [f"{one.name.replace(',', ';')},{n}" for one, n in zip(beside, "660", strict=True)]
    table = zip(rows, ["in,5", "out,-5", "in,1e-3"], strict=True)
    content = "no,n,w,mA,u\n" + "".join(f"{head},{rest},2e-6\n" for head, rest in table)
    written = read_csv_table(tmp_path, content, below)
    uncertain = BESIDE.replace(', u = "u"', "").replace('"minus" }', '"minus", u = "u" }')
    one, other = read_csv_table(tmp_path, "n,plus,minus,u\n6,5,-5,2e-6\n", uncertain)
    assert (one.u, other.u) == (None, pytest.approx(2e-6 / 1.25))
    assert [replace(one, name=one.name.replace(";", ",")) for one in written] == list(beside)


def test_invalid_mounting_columns_raise(tmp_path):
    table = "n,plus,minus,u\n6,5,-5,2e-6\n"
    (problem,) = read_problems(tmp_path, table, BESIDE.replace('"minus"', '"minos"'))
    assert problem == 'readings.columns: r.csv has no column "minos"; did you mean "minus"?'
    problem = "readings.mountings: give `reading` for every mounting"
    for slip in (
        BESIDE.replace(', reading = "minus"', ""),
        BESIDE.replace('u = "u"', 'u = "u", reading = "plus"'),
    ):
        assert read_problems(tmp_path, table, slip)[0].startswith(problem)
    rows = "n,plus,minus,u\nrad/s,mA,V,mA\n6,5,-5,2e-6\n7,6,-6,2e-6\n8,6,-6,2e-6\n"
    (problem,) = read_problems(tmp_path, rows, BESIDE)
    assert problem.endswith(
        'column "minus" is in V according to the units row, but in mA according to the description'
    )


def test_sense_of_row_overrides_sense_of_table(tmp_path):
    keys = 'sense = "clockwise"\n' + ARM.replace("columns = {", 'columns = { sense = "s",')
    table = "n,side,s,mA\n6,innen,CCW,5\n6,innen,cw,5\n6,innen,,5\n0,innen,,0\n"
    assert [one.rate for one in read_csv_table(tmp_path, table, keys)] == [6.0, -6.0, -6.0, 0.0]
    (problem,) = read_problems(tmp_path, table.replace("CCW", "left"), keys)
    assert problem.startswith(
        "readings.\"r.csv line 2\".sense: 'left' is not one of counterclockwise,"
    )


def test_footer_lines_are_not_readings(tmp_path):
    table = "n,side,mA\n6,innen,5\n0,innen,0\n,,\n,Table 3 of 4,\n"
    assert len(read_csv_table(tmp_path, table, ARM)) == 2
    # What was read has a station, or should have one.
    assert len(read_problems(tmp_path, f"{table},innen,5\n", ARM)) == 1


def test_dot_in_mounting_name_is_removed(tmp_path):
    keys = ARM.replace("innen =", '"Pos 1" =').replace("hinten =", '"22,5" =')
    csv_table = read_csv_table(tmp_path, "n,side,mA\n6,Pos. 1,5\n6,22.5,0\n", keys)
    assert [one.mounting for one in csv_table] == ["Pos 1", "22,5"]


def test_merged_cell_repeats_mounting(tmp_path):
    table = "n,side,mA\n6,innen,5\n6,,5\n\n6,hinten,0\n6,,0\n"
    csv_table = read_csv_table(tmp_path, table, "merged = true\n" + ARM)
    assert [one.mounting for one in csv_table] == ["innen", "innen", "hinten", "hinten"]
    assert csv_table[1].axes == csv_table[0].axes
    assert len(read_problems(tmp_path, table, ARM)) == 2


@pytest.mark.parametrize(
    ("unit", "number", "rate"),
    [
        ("rad/s", 6.0, 6.0),
        ("rpm", 60.0, 2.0 * math.pi),
        ("1/min", 60.0, 2.0 * math.pi),
        ("Hz", 2.0, 4.0 * math.pi),
        ("s", 0.5, 4.0 * math.pi),
        ("ms", 500.0, 4.0 * math.pi),
        # w^2 R, with the gravity 9.8 m/s^2 and the radius 1 m of the description.
        ("m/s^2", 36.0, 6.0),
        ("g", 10.0, math.sqrt(98.0)),
    ],
)
@pytest.mark.parametrize(("sense", "sign"), [("counterclockwise", 1.0), ("clockwise", -1.0)])
def test_rate_columns_are_converted(tmp_path, unit, number, rate, sense, sign):
    keys = f'rate_unit = "{unit}"\nsense = "{sense}"\n{ARM}'
    (reading,) = read_csv_table(tmp_path, f"n,side,mA\n{number},innen,5\n", keys)
    assert reading.rate == pytest.approx(sign * rate, rel=1e-12)


def test_common_u_applies_to_readings_without_u(tmp_path):
    keys = 'columns = { attitude = "angle", reading = "mA", u = "u" }\nu = "5 uA"\n'
    own, other = read_csv_table(tmp_path, "angle,mA,u\n0,1.25,0.001\n90,0,\n", keys)
    assert own.u == pytest.approx(0.001 / 1.25)
    assert other.u == pytest.approx(0.005 / 1.25)


def test_repeat_columns_may_have_empty_cells(tmp_path):
    keys = 'columns = { attitude = "angle", reading = ["a", "b", "c"] }'
    first, second = read_csv_table(tmp_path, "angle,a,b,c\n0,1.25,1.26,1.27\n90,0,0.01,\n", keys)
    assert (first.value, first.repeats, first.u) == (pytest.approx(1.26 / 1.25), 3, None)
    assert first.scatter == pytest.approx(2e-4 / 1.25**2)
    assert (second.value, second.repeats) == (pytest.approx(0.005 / 1.25), 2)


def test_head_uncertainty_and_axis_are_read(tmp_path):
    (reading,) = read_csv_table(tmp_path, "angle,mA\n30,1\n", SIMPLE + '\nu_attitude = "2 arcsec"')
    assert reading.u_head == pytest.approx(math.radians(2 / 3600))
    assert reading.head == (0.0, 1.0, 0.0)


def test_head_angle_column_differs_from_attitude(tmp_path):
    keys = SIMPLE.replace("reading", 'head = "shown", reading')
    first, second = read_csv_table(tmp_path, "angle,shown,mA\n30,120,1\n60,,1\n", keys)
    assert first.head_angle == pytest.approx(math.radians(120.0))
    assert second.head_angle == pytest.approx(math.radians(60.0))
    assert first.head == second.head == (0.0, 1.0, 0.0)


def test_dates_are_converted_to_time(tmp_path):
    keys = 'columns = { attitude = "angle", reading = "mA", time = "when" }'
    table = "angle,mA,when\n0,1.25,2024-05-01 10:00:00\n90,0,2024-05-01 10:02:30.5\n"
    first, second = read_csv_table(tmp_path, table, keys)
    assert second.time - first.time == 150.5


def test_time_may_begin_with_day(tmp_path):
    keys = 'columns = { attitude = "angle", reading = "mA", time = "when" }'
    table = "angle,mA,when\n0,1.25,30.04.2024 10:00\n90,0,01.05.2024 10:02:30\n"
    first, second = read_csv_table(tmp_path, table, keys)
    assert second.time - first.time == 86550.0


@pytest.mark.parametrize("cell", ["30°", "30 deg", "1800 arcmin", "30 ± 0 deg about north"])
def test_angle_may_have_its_unit(tmp_path, cell):
    keys = SIMPLE + '\nabout = "north"\nu_attitude = "2 arcsec"'
    written, plain = read_csv_table(tmp_path, f"angle,mA\n{cell},1\n30,1\n", keys)
    assert written.head_angle == pytest.approx(plain.head_angle)
    assert written.head == plain.head
    if "about" not in cell:
        assert written.u_head == pytest.approx(plain.u_head)


@pytest.mark.parametrize(
    ("names", "keys", "unit", "stated"),
    [
        ("angle_rad,mA", 'attitude = "angle_rad", reading = "mA"', "rad", "deg"),
        ("angle [rad],mA", 'attitude = "angle [rad]", reading = "mA"', "rad", "deg"),
        ("angle,uA", 'attitude = "angle", reading = "uA"', "uA", "mA"),
        ("angle,out (V)", 'attitude = "angle", reading = "out (V)"', "V", "mA"),
    ],
)
def test_unit_in_column_name_differs_from_description(tmp_path, names, keys, unit, stated):
    (problem,) = read_problems(tmp_path, f"{names}\n0,1\n1,0.5\n", f"columns = {{ {keys} }}")
    assert problem.endswith(
        f"is in {unit} according to its name, but in {stated} according to the description"
    )


@pytest.mark.parametrize("name", ["n [1/min]", "n_rpm", "n_min", "rate"])
def test_unit_in_column_name_agrees_with_description(tmp_path, name):
    keys = f"""motion = "arm"
rate_unit = "rpm"
columns = {{ rate = "{name}", reading = "mA" }}
axes = {{ input = "inward", pendulous = "up" }}
"""
    (reading,) = read_csv_table(tmp_path, f"{name},mA\n60,5\n", keys)
    assert reading.rate == pytest.approx(2.0 * math.pi)


def test_empty_rows_are_ignored(tmp_path):
    assert len(read_csv_table(tmp_path, "angle,mA\n0,1.25\n,\n90,0\n")) == 2


def test_table_without_accelerometer_raises(tmp_path):
    (tmp_path / "r.csv").write_text("angle,mA\n0,1\n", encoding="utf-8")
    text = f'{format_site()}[readings]\nfile = "r.csv"\n{SIMPLE}\n'
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match="accelerometers"):
        read_campaign(tmp_path)


def test_decimal_commas_are_read(tmp_path):
    table = "Lage;Winkel;U\nhoch, links;0,5;-1,25e-1\nhoch;-,5;3\n"
    keys = 'columns = { name = "Lage", attitude = "Winkel", reading = "U" }\ndecimal = ","'
    first, second = read_csv_table(tmp_path, table, keys)
    assert (first.name, first.value) == ("hoch, links", pytest.approx(-0.1))
    assert second.value == pytest.approx(3.0 / 1.25)


#: As the recorder of a German laboratory writes it.
GERMAN = (
    "Pr\xfcfstand 3\nLage;Winkel;Strom\n;deg;uA\nP1;0,0;1250,5\nP2;90,0;0,5\nP3;180,0;-1249,5\n"
)
GERMAN_KEYS = (
    'columns = { name = "Lage", attitude = "Winkel", reading = "Strom" }\ndecimal = ","\n'
    'encoding = "latin-1"\n'
)


@pytest.mark.parametrize("message", ["", 'skip_lines = 1\nunits_row = true\ndelimiter = ";"\n'])
def test_table_layout_is_detected_or_stated(tmp_path, message):
    """Lines before the names and a row of units are found, as in records, or said."""
    (tmp_path / "r.csv").write_bytes(GERMAN.replace("uA", "mA").encode("latin-1"))
    readings = read(tmp_path, f'[readings]\nfile = "r.csv"\n{GERMAN_KEYS}{message}').readings
    assert [reading.name for reading in readings] == ["P1", "P2", "P3"]
    assert [reading.value * 1.25 for reading in readings] == pytest.approx([1250.5, 0.5, -1249.5])


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252", "utf-8", "utf-16"])
def test_text_is_decoded_in_all_encodings(tmp_path, encoding):
    table = "Lage;Winkel;Strom;Temp\n;deg;mA;°C\naußen;0,0;1,25;21,5\nüber Kopf;180,0;-1,25;22\n"
    (tmp_path / "r.csv").write_bytes(table.encode(encoding))
    keys = GERMAN_KEYS.replace('encoding = "latin-1"\n', "").replace(
        'reading = "Strom"', 'reading = "Strom", temperature = "Temp"'
    )
    readings = read(tmp_path, f'[readings]\nfile = "r.csv"\n{keys}').readings
    assert [reading.name for reading in readings] == ["außen", "über Kopf"]
    # The row of units is one, temperatures among them, and no reading.
    assert [reading.temperature for reading in readings] == [(294.65,), (295.15,)]  # K


@pytest.mark.parametrize("temperature", ["1e4", "1e18", "-300", "1e18 K"])
@pytest.mark.parametrize("row", [0, 2])
def test_implausible_temperature_raises_with_row(tmp_path, row, temperature):
    lines = ["Lage,Winkel,Strom,Temp", "a,0,1.25,21", "b,90,0,21", "c,180,-1.25,21"]
    lines[row + 1] = lines[row + 1].removesuffix("21") + temperature
    (tmp_path / "r.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    columns = 'name = "Lage", attitude = "Winkel", reading = "Strom", temperature = "Temp"'
    with raises("value-out-of-range") as caught:
        read(tmp_path, f'[readings]\nfile = "r.csv"\ncolumns = {{ {columns} }}\n')
    assert f"row {row + 2}" in str(caught.value) or f"line {row + 2}" in str(caught.value)


def test_conflicting_units_row_raises(tmp_path):
    (tmp_path / "r.csv").write_bytes(GERMAN.encode("latin-1"))
    with raises("unit-mismatch", '"Strom"', "uA"):
        read(tmp_path, f'[readings]\nfile = "r.csv"\n{GERMAN_KEYS}')


def test_sheet_may_have_rows_before_header(tmp_path):
    rows = [["Messung", 7], ["angle", "mA"], ["deg", "mA"], [0, 1.25], [90, 0.0]]
    write_workbook(tmp_path / "r.xlsx", {"Tumble": rows})
    text = f'[readings]\nfile = "r.xlsx"\n{SIMPLE}\nskip_lines = 1\nunits_row = true\n'
    assert [reading.value for reading in read(tmp_path, text).readings] == [1.0, 0.0]


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ('about = "nort"', 'readings.about: unknown direction "nort"; did you mean "north"?'),
        ('u_attitude = "-2 arcsec"', "readings.u_attitude: a standard uncertainty cannot be neg"),
        ('u = "-2 uA"', "readings.u: a standard uncertainty cannot be negative"),
        ('u_rate = "-2 rad/s"', "readings.u_rate: a standard uncertainty cannot be negative"),
    ],
)
def test_invalid_value_of_section_is_reported_once(tmp_path, key, expected):
    (problem,) = read_problems(tmp_path, "angle,mA\n0,1.25\n90,0\n", f"{SIMPLE}\n{key}")
    assert problem.startswith(expected)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"up"', '"upp"', ["accelerometers.A.input_axis: unknown direction"]),
        ("[readings]", "[reading]", ["reading: unknown key;", "runs: is missing"]),
        ('mA" }', 'Ma" }', ["readings.columns: r.csv has no column"]),
    ],
)
def test_mistake_that_hides_readings_is_no_mistake_of_their_terms(tmp_path, old, new, expected):
    (tmp_path / "r.csv").write_text("angle,mA\n0,1.25\n90,0\n", encoding="utf-8")
    text = f'{HEAD}[readings]\nfile = "r.csv"\n{SIMPLE}\n[model]\nterms = ["K_II", "head.zero"]\n'
    text += (
        '[model.priors]\n"head.harmonic" = "0 ± 1 arcsec"\n[truth.machine]\n"head.zero" = "1 rad"\n'
    )
    (tmp_path / "campaign.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(CampaignError) as caught:
        read_campaign(tmp_path)
    problems = caught.value.problems
    for start in expected:
        assert any(problem.startswith(start) for problem in problems)
    assert not any("head." in problem for problem in problems)


def test_same_mistake_in_many_rows_is_reported_once(tmp_path):
    table = "angle,mA\nfirst,1.25\nsecond,0\nthird,0\n30,x\nfourth,1\n"
    first, other = read_problems(tmp_path, table)
    assert first.startswith('readings."r.csv line 2".attitude: is not an attitude; write')
    assert first.endswith(' (the same in 4 rows, up to "r.csv line 6")')
    assert other.startswith('readings."r.csv line 5".')
    # In a few rows, each is named.
    assert len(read_problems(tmp_path, table.replace("third", "60"))) == 4


SLIPS = {
    "decimal commas that show": (
        "angle;mA\n0,5;1,25\n30,5;1,0\n60,5;0,5\n",
        SIMPLE,
        'readings.decimal: is missing: r.csv has decimal commas; write decimal = ","',
    ),
    "a decimal comma beside words": (
        "angle;what;note;mA\nlevel;up;-;1,25\n",
        SIMPLE,
        """line 2".mA: '1,25' has a decimal comma; write decimal = "," in [readings]""",
    ),
    "no rows": ("angle,mA\n", SIMPLE, "readings.file: r.csv has no rows below the header row"),
    "a motion that is none": (
        "angle,how,mA\n0,static,1\n90,arms,2\n",
        'columns = { attitude = "angle", motion = "how", reading = "mA" }',
        ".motion: 'arms' is not one of 'counter-rotating', 'arm', 'static' or 'vibration'",
    ),
    "no such column": (
        "angle,mA\n0,1.25\n",
        SIMPLE.replace("angle", "angel"),
        'readings.columns: r.csv has no column "angel"; did you mean "angle"?',
    ),
    "no value": (
        "# made by hand\nangle,mA\n0,1.25\n30,\n",
        SIMPLE,
        'readings."r.csv line 4".reading: has no value yet; enter the reading',
    ),
    "two readings without a value": (
        "angle,mA\n0,1.25\n30,\n60,\n",
        SIMPLE,
        "has no value yet, nor does another reading; enter the reading",
    ),
    "several readings without a value": (
        "angle,mA\n0,\n30,\n60,\n",
        SIMPLE,
        "has no value yet, nor do 2 others; enter the reading",
    ),
    "no position": (
        "angle,mA\n0,1.25\n,0.5\n",
        SIMPLE,
        'readings."r.csv line 3".attitude: is missing: a reading at rest requires a position',
    ),
    "no column of positions": (
        "angle,mA\n0,1.25\n30,1.1\n60,0.6\n",
        'columns = { reading = "mA" }',
        "readings.columns: attitude is missing; give the column with the position of each reading",
    ),
    "no column of rates": (
        "w,mA\n6,1.25\n7,1.1\n",
        'columns = { reading = "mA" }\nmotion = "arm"\n'
        'axes = { input = "inward", pendulous = "up" }',
        "readings.columns: rate is missing; give the column with the rate of each reading",
    ),
    "no rate": (
        "w,mA\n6,1.25\n,1.1\n",
        'columns = { rate = "w", reading = "mA" }\nmotion = "arm"\n'
        'axes = { input = "inward", pendulous = "up" }',
        'readings."r.csv line 3".rate: is missing: a reading on an arm requires a rate',
    ),
    "no such mounting": (
        "n,side,mA\n6,inen,1.25\n",
        ARM,
        'readings."r.csv line 2": readings.mountings does not contain "inen"; did you mean '
        '"innen"?',
    ),
    "no such mounting at rest": (
        "n,side,mA\n6,innen,1.25\n0,hoch,1.25\n",
        ARM.replace('axes_at_rest = { input = "up", pendulous = "outward" }', ""),
        'readings."r.csv line 3": readings.mountings does not contain "hoch"',
    ),
    "mountings without their column": (
        "n,mA\n6,1.25\n",
        ARM.replace('mounting = "side", ', ""),
        "readings.columns: mounting is missing; give the column with the mounting of each reading",
    ),
    "axes of a mounting": (
        "n,side,mA\n6,innen,1.25\n",
        ARM.replace('{ input = "inward"', '{ inpt = "inward", input = "inward"'),
        'readings.mountings.innen.inpt: unknown key; did you mean "input"?',
    ),
    "a rate in no unit of it": (
        "n,side,mA\n6,innen,1.25\n",
        f'rate_unit = "kg"\n{ARM}',
        "readings.rate_unit: unknown unit 'kg'; an angular rate is required",
    ),
    "an acceleration with a sign": (
        "n,side,mA\n-6,innen,1.25\n",
        f'rate_unit = "g"\n{ARM}',
        'readings."r.csv line 2".rate: a centripetal acceleration must be positive',
    ),
    "no such sense": (
        "n,side,mA\n6,innen,1.25\n",
        f'sense = "left"\n{ARM}',
        "readings.sense: 'left' is not one of 'counterclockwise' or 'clockwise'",
    ),
    "u in another unit": (
        "angle,mA\n0,1.25\n",
        f'u = "5 uV"\n{SIMPLE}',
        "readings.u: 'uV' cannot be converted to mA",
    ),
    "a rate at rest": (
        "angle,w,mA\n0,0,1.25\n30,6.28,1.1\n",
        'columns = { attitude = "angle", rate = "w", reading = "mA" }',
        'readings."r.csv line 3".rate: a static run has no rotation; omit the rate',
    ),
    "text for a rate": (
        "w,mA\nfast,1.25\n",
        'columns = { rate = "w", reading = "mA" }\nmotion = "arm"\n'
        'axes = { input = "inward", pendulous = "up" }',
        "readings.\"r.csv line 2\".rate: 'fast' is not a number",
    ),
    "another unit": (
        "angle,mA\n0,1.25 V\n",
        SIMPLE,
        "readings.\"r.csv line 2\".reading.A: 'V' cannot be converted to mA",
    ),
    "a time without a date": (
        "angle,mA,t\n0,1.25,10:20\n",
        'columns = { attitude = "angle", reading = "mA", time = "t" }',
        "line 2\".time: '10:20' is not a date and time; write 2026-03-01 10:20:00, or seconds",
    ),
    "a sheet of no workbook": (
        "angle,mA\n0,1.25\n",
        SIMPLE + '\nsheet = "Tumble"',
        "readings.file: r.csv: only a workbook (.xlsx) has sheets",
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_error_in_table_has_one_message(tmp_path, slip):
    content, keys, message = SLIPS[slip]
    (line,) = read_problems(tmp_path, content, keys)
    assert message in line
