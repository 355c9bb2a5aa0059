"""Simulated readings in files: values where they were missing, all else as it was."""

import math
import tomllib

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.simulation.simulate import simulate

TEXT = """# of the laboratory
schema = 1
site = { gravity = "9.8066 m/s^2", latitude = "45.75 deg" }

[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
specific_force = { column = "mA", unit = "mA" }

[centrifuge]
radius = "1.0 m"

[records]
time = { column = "t", unit = "s" }

[model]
assume = "all"
terms = ["K_F", "K_I", "K_II"]

[readings]
file = "tables/readings.csv"
columns = { name = "position", attitude = "deg", reading = "mA", u = "u" }

[[runs]]                             # the arm
name = "in 10"
motion = "arm"
rate = "9.9 rad/s"
axes = { input = "inward", pendulous = "up" }
reading = "? +/- 2 nA"               # in another unit

[[runs]]
name = "out 10"
motion = "arm"
rate = "9.9 rad/s"
axes = { input = "outward", pendulous = "up" }
reading = "? ± 2e-6 mA"

[[runs]]
name = "rest"
motion = "static"
attitude = "level"
record = "rest.parquet"
duration = "20 s"

[truth.A]
K_F = "2e-3 g"
K_I = "1.0005 g/g"
K_II = "15e-6 g/g^2"

[truth.noise]
specific_force = "20 ug"
"""


def write_campaign(folder, text=TEXT):
    (folder / "tables").mkdir(parents=True)
    rows = "".join(f"{i * 30} deg,{i * 30},,2e-6\n" for i in range(12))
    (folder / "tables" / "readings.csv").write_text("position,deg,mA,u\n" + rows, "utf-8")
    (folder / "campaign.toml").write_text(text, "utf-8")
    return folder


def test_readings_are_filled_and_other_content_is_unchanged(tmp_path):
    folder = tmp_path / "made"
    written = simulate(write_campaign(tmp_path / "own"), folder)
    assert written == (folder / "rest.parquet", folder / "tables" / "readings.csv")
    before, after = TEXT.splitlines(), (folder / "campaign.toml").read_text("utf-8").splitlines()
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert [a for a, _ in changed] == [
        line for line in before if "? " in line and "reading" in line
    ]
    readings = read_campaign(folder).readings
    assert [r.u for r in readings[:2]] == [pytest.approx(1.6e-6)] * 2
    assert readings[0].value == pytest.approx(10.002, abs=0.01)
    table = pl.read_csv(folder / "tables" / "readings.csv")
    assert table["mA"].null_count() == 0
    assert table["u"].to_list() == [2e-6] * 12
    assert [r.value for r in readings[3:]] == pytest.approx(
        [
            2e-3 + 1.0005 * math.cos(a) + 15e-6 * math.cos(a) ** 2
            for a in (math.radians(30 * i) for i in range(12))
        ],
        abs=1.6e-6 * 6,
    )


def test_noise_is_stated_or_true_noise(tmp_path):
    runs = "".join(
        f'[[runs]]\nname = "{i}"\nmotion = "static"\nattitude = "level"\n'
        'reading = ["? ± 3e-6 mA", "? ± 3e-6 mA"]\n'
        for i in range(200)
    )
    text = TEXT[: TEXT.index("[readings]")] + runs + TEXT[TEXT.index("[truth.A]") :]
    for name, more, u in (("stated", "", 3e-6), ("true", 'reading = "5 nA"\n', 5e-6)):
        simulate(write_campaign(tmp_path / name, text + more), tmp_path / name / "made")
        document = tomllib.loads((tmp_path / name / "made" / "campaign.toml").read_text("utf-8"))
        values = [float(v.split()[0]) for run in document["runs"] for v in run["reading"]]
        off = np.array(values) - 1.25 * (2e-3 + 1.0005 + 15e-6)
        # Five standard errors of a standard deviation and of a mean of 400.
        assert abs(off.std() / u - 1.0) < 5.0 / math.sqrt(800)
        assert abs(off.mean()) < 5.0 * u / 20.0


def test_mounting_columns_are_filled_separately(tmp_path):
    """Of a row only what is read, or blank in all; at rest level, the centripetal force else."""
    table = """motion = "arm"
columns = { rate = "w" }
[readings.mountings]
in = { input = "inward", pendulous = "up", reading = "plus", u = "u" }
out = { input = "outward", pendulous = "up", reading = "minus", u = "v" }
"""
    start, end = TEXT.index("columns = { name"), TEXT.index("[[runs]]")
    own = write_campaign(tmp_path / "own", TEXT[:start] + table + TEXT[end:])
    rows = "w,plus,minus,u,v\n9.9,,,1e-9,2e-9\n0,,,1e-9,2e-9\n9.9,,1,1e-9,2e-9\n"
    (own / "tables" / "readings.csv").write_text(rows, "utf-8")
    simulate(own, tmp_path / "made")
    filled = pl.read_csv(tmp_path / "made" / "tables" / "readings.csv")
    assert filled["plus"].null_count() == 1
    earth = 7.292115e-5 * math.sin(math.radians(45.75))
    force = (9.9**2 + 2.0 * 9.9 * earth) / 9.8066
    values = [1.25 * (2e-3 + 1.0005 * f + 15e-6 * f**2) for f in (force, 0.0, -force, 0.0, -force)]
    filled_values = [*filled["plus"][:2], *filled["minus"]]
    assert filled_values == pytest.approx(values, abs=1e-7)


def test_noise_of_table_is_u_of_its_readings(tmp_path):
    """Rows without a stated uncertainty use the uncertainty of the section."""
    text = TEXT.replace(
        'columns = { name = "position",', 'u = "4 nA"\ncolumns = { name = "position",'
    )
    own = write_campaign(tmp_path / "own", text)
    count = 400
    rows = "".join(f"{i},0,,{'2e-5' if i % 2 else ''}\n" for i in range(count))
    (own / "tables" / "readings.csv").write_text("position,deg,mA,u\n" + rows, "utf-8")
    simulate(own, tmp_path / "made")
    table = pl.read_csv(tmp_path / "made" / "tables" / "readings.csv")
    off = table["mA"].to_numpy() - 1.25 * (2e-3 + 1.0005 + 15e-6)
    for part, u in ((off[::2], 4e-6), (off[1::2], 2e-5)):
        # Five standard errors of the size of half of them.
        assert abs(np.sqrt(np.mean(part**2)) / u - 1.0) < 5.0 / math.sqrt(count)


def test_table_with_special_layout_raises(tmp_path):
    text = TEXT.replace('file = "tables', 'delimiter = ","\nfile = "tables')
    with raises("conflicting-keys", "readings.delimiter:"):
        simulate(write_campaign(tmp_path / "own", text), tmp_path / "made")


def test_repeat_count_of_table_is_unchanged(tmp_path):
    own = write_campaign(tmp_path / "own", TEXT.replace('"mA", u =', '["mA", "again"], u ='))
    rows = "".join(f"{i * 30},,{'' if i else 1},2e-6,{i * 30} deg\n" for i in range(12))
    (own / "tables" / "readings.csv").write_text("deg,mA,again,u,position\n" + rows + ",,,,\n")
    simulate(own, tmp_path / "made")
    table = pl.read_csv(tmp_path / "made" / "tables" / "readings.csv")
    assert table["mA"].null_count() == 2  # of the first row, which has one reading, and the last
    assert table["again"].null_count() == 1
    assert [r.repeats for r in read_campaign(tmp_path / "made").readings[3:]] == [1] + [2] * 11


def test_calibration_of_simulated_readings_returns_truth(tmp_path):
    simulate(write_campaign(tmp_path / "own"), tmp_path / "made")
    coefficients = calibrate(tmp_path / "made").accelerometers["A"].coefficients
    for symbol, truth in (("K_F", 2e-3), ("K_I", 1.0005), ("K_II", 15e-6)):
        assert abs(coefficients[symbol].value - truth) < 4.0 * coefficients[symbol].u


def test_output_zero_is_simulated_and_calibrated(tmp_path):
    """A current loop adds 12 mA to each value and changes nothing else."""
    twelve = TEXT.replace('"1.25 mA/g" }', '"1.25 mA/g", zero = "12 mA" }')
    for name, text in (("zero", TEXT), ("twelve", twelve)):
        simulate(write_campaign(tmp_path / name, text), tmp_path / name / "made")
    plain, moved = (tmp_path / name / "made" for name in ("zero", "twelve"))
    values = [
        pl.read_parquet(folder / "rest.parquet")["mA"].to_numpy() for folder in (plain, moved)
    ]
    np.testing.assert_allclose(values[1], values[0] + 12.0, rtol=1e-14)
    values = [pl.read_csv(f / "tables" / "readings.csv")["mA"].to_numpy() for f in (plain, moved)]
    np.testing.assert_allclose(values[1], values[0] + 12.0, atol=1e-12)
    first, second = (calibrate(folder).accelerometers["A"] for folder in (plain, moved))
    for symbol, c in second.coefficients.items():
        assert abs(c.value - first.coefficients[symbol].value) < 1e-4 * c.u
        assert c.u == pytest.approx(first.coefficients[symbol].u, rel=1e-4)
    bias = second.output["bias"]
    assert bias.value == pytest.approx(12.0 + 1.25 * second.coefficients["K_F"].value, rel=1e-14)
    assert second.output["scale_factor"].value == pytest.approx(
        first.output["scale_factor"].value, rel=1e-9
    )


def test_same_seed_writes_same_files(tmp_path):
    own = write_campaign(tmp_path / "own")
    for place in ("first", "second"):
        simulate(own, tmp_path / place)
    for name in ("campaign.toml", "tables/readings.csv", "rest.parquet"):
        first, second = ((tmp_path / place / name).read_bytes() for place in ("first", "second"))
        assert first == second
    other = TEXT + "[simulation]\nseed = 2\n"
    simulate(write_campaign(tmp_path / "other", other), tmp_path / "third")
    texts = {(tmp_path / place / "campaign.toml").read_text() for place in ("first", "third")}
    assert len({tomllib.loads(t)["runs"][0]["reading"] for t in texts}) == 2


def test_inline_description_is_rewritten(tmp_path):
    start = TEXT.index("[[runs]]")
    end = TEXT.index("[truth.A]")
    runs = tomllib.loads(TEXT)["runs"]
    quoted = [
        "{" + ", ".join(f"{k} = {format_inline(v)}" for k, v in run.items()) + "}" for run in runs
    ]
    # Literal strings, which a search for quotation marks does not find.
    text = TEXT[:start] + TEXT[end:]
    text = text.replace("schema = 1", f"schema = 1\nruns = [{', '.join(quoted)}]")
    simulate(write_campaign(tmp_path / "own", text), tmp_path / "made")
    simulate(write_campaign(tmp_path / "usual"), tmp_path / "known")
    texts = [(tmp_path / p / "campaign.toml").read_text("utf-8") for p in ("made", "known")]
    assert tomllib.loads(texts[0]) == tomllib.loads(texts[1])


def format_inline(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = '{v}'" for k, v in value.items()) + "}"
    return f"'{value}'"


def test_existing_files_require_overwrite(tmp_path, capsys):
    own = write_campaign(tmp_path / "own")
    with raises("file-exists", "readings.csv"):
        simulate(own, own)
    assert (own / "campaign.toml").read_text("utf-8") == TEXT
    assert main(["simulate", str(own), "-o", str(own), "--overwrite"]) == 0
    assert "?" not in (own / "campaign.toml").read_text("utf-8").replace("[truth", "")
    assert "Wrote 2 files and campaign.toml" in capsys.readouterr().out
    calibrate(own)


def test_blank_readings_raise(tmp_path):
    with raises("missing-value", '"in 10"', "13 other readings"):
        calibrate(
            write_campaign(
                tmp_path / "own",
                TEXT.replace('record = "rest.parquet"', 'reading = "1.25 ± 1e-6 mA"').replace(
                    'duration = "20 s"\n', ""
                ),
            )
        )


def test_unsupported_record_format_raises(tmp_path):
    own = write_campaign(tmp_path / "own", TEXT.replace("rest.parquet", "rest.h5"))
    with raises("not-simulable", '"rest":', "rest.h5"):
        simulate(own, tmp_path / "made")


def test_readings_in_memory_equal_readings_in_folder(tmp_path):
    text = TEXT[: TEXT.index("[readings]")] + TEXT[TEXT.index("[[runs]]") :]
    own = write_campaign(tmp_path / "own", text)
    simulate(own, tmp_path / "made")
    in_memory = simulate(own)
    written = read_campaign(tmp_path / "made")
    assert in_memory.source.document == written.source.document
    parquet = pl.read_parquet(tmp_path / "made" / "rest.parquet")
    columns = in_memory.record_at(in_memory.readings[-1].record).columns
    np.testing.assert_array_equal(columns["mA"], parquet["mA"].to_numpy())
    assert simulate(in_memory).source.document == written.source.document


def test_table_in_memory_raises(tmp_path):
    with raises("wrong-usage"):
        simulate(write_campaign(tmp_path / "own"))
