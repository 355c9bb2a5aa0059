"""`counterspin apply`: corrections recover the force, and invalid requests are rejected."""

import io
import math
import re
import shlex
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from raising import raises
from results import make_accelerometer_result as found_of
from results import make_bare_result, remove_seal
from results import make_run as moved
from scipy.io import savemat
from workbooks import write_workbook

import counterspin as cs
from counterspin import cli
from counterspin.calibration.findings import judge_result, not_determined_finding
from counterspin.calibration.outcome import describe_instrument
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Correlation,
    Knowledge,
    NominalOutput,
    ReadingResult,
)
from counterspin.correction.apply import ApplyOptions, apply
from counterspin.correction.apply_file import _stated_units, apply_file
from counterspin.correction.instrument import make_instrument
from counterspin.errors import CampaignError, ConvergenceError
from counterspin.inference.joint.summary import BudgetLine, Jackknife
from counterspin.physics.accelerometer import QX, QY, QZ, indicated
from counterspin.physics.terms import TERMS

PAGE = (Path(__file__).parents[2] / "docs" / "apply.md").read_text(encoding="utf-8")
G = 9.8066

MODEL = {"K_F": 0.0050, "K_I": 1.0020, "K_II": 2.7e-5, "K_III": 3e-6}
CROSS = {"K_IP": 4e-5, "K_PP": -2e-5, "K_OO": 1e-5, "delta_O": 2e-4, "delta_P": -3e-4}
MOUNTINGS = {"Qx": QX, "Qy": QY, "Qz": QZ}


def make_coefficient(symbol, value, u=0.0, estimated=True, **more):
    unit = TERMS[symbol].unit
    return Coefficient(value=value, u=u, unit=unit, estimated=estimated, **more)


def make_accelerometer(values, mounting=QX, **changes):
    parts = {
        "coefficients": {s: make_coefficient(s, v) for s, v in values.items()},
        "axes": list(mounting.axes),
        "observable": "displacement",
    }
    return found_of(**(parts | changes))


def make_result(accelerometers=None, model="exact", rate=4 * math.pi):
    return make_bare_result(
        model=model,
        accelerometers=accelerometers or {"Qx": make_accelerometer(MODEL)},
        runs={"run1": moved(rate=rate)},
    )


def make_three():
    models = {
        name: {s: v * (1 + k / 7) for s, v in (MODEL | CROSS).items()} | {"K_I": 1 + 1e-3 * k}
        for k, name in enumerate(MOUNTINGS)
    }
    result = make_result({n: make_accelerometer(models[n], m) for n, m in MOUNTINGS.items()})
    return result, models


def run(*words):
    return cli.main(["apply", *map(str, words)])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cs.write_result(make_result(), tmp_path / "result.json")
    return tmp_path


def write_table(text, name="data.csv"):
    Path(name).write_text(text, encoding="utf-8")
    return name


# --- default priors -------------------------------------------------------------------------------


def default_prior(symbol, u):
    return Knowledge(name=f"Qx.{symbol}", kind="unstated", unit=TERMS[symbol].unit, value=0.0, u=u)


def test_default_prior_is_in_u_where_force_is_known():
    rows = [default_prior("K_4", 1e-9), default_prior("K_OO", 2e-6), default_prior("K_IP", 2e-6)]
    result = make_result().model_copy(update={"rests_on": rows})
    taken = apply(result, "Qx", np.array([10.0]))
    assert taken.corrected == pytest.approx(apply(make_result(), "Qx", np.array([10.0])).corrected)
    # 1e-9 of the force to the fourth power over the slope of the model, which is K_I within 1e-3.
    of_fourth = 1e-9 * taken.corrected[0] ** 4
    assert taken.u == pytest.approx([of_fourth], rel=5e-3)
    (warning,) = (w for w in taken.warnings if "no value is stated" in w)
    assert "K_OO, K_IP" in warning
    across = apply(result, "Qx", np.array([10.0]), ApplyOptions(output_axis="3 g"))
    assert across.u == pytest.approx([math.hypot(of_fourth, 2e-6 * 9.0)], rel=5e-3)
    (warning,) = (w for w in across.warnings if "no value is stated" in w)
    assert "K_IP" in warning
    assert "K_OO" not in warning


# --- the page -------------------------------------------------------------------------------------


def find_code_blocks(kind):
    return re.findall(rf"^```{kind}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_documentation_example_recovers_truth(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (csv,) = find_code_blocks("csv")
    write_table(csv, "flight.csv")
    for line in "".join(find_code_blocks("sh")).splitlines():
        program, *words = shlex.split(line)
        assert program == "counterspin"
        assert cli.main(words) == 0, line
    report = capsys.readouterr().out
    assert "4 rows of Qx, from -1.0005 to 9.5213 g" in report
    assert "applied as estimated: K_II, K_III; from priors: K_F, K_I" in report
    accelerometer = cs.read_result(tmp_path / "result.json").accelerometers["Qx"]
    assert accelerometer.axes == list(QX.axes)
    assert accelerometer.observable == "displacement"

    # The truth of the example campaign, by the closed form of the error model.
    truth = cs.read_campaign(tmp_path / "example").simulation.truth.coefficients["Qx"]
    table = pl.read_csv("corrected.csv")
    force = np.stack([table["Qx_corrected"].to_numpy(), *np.zeros((2, 4))], axis=1)
    departure = np.abs(indicated(QX, truth, force @ QX.matrix) - table["Qx"].to_numpy())
    u = table["Qx_corrected_u"].to_numpy()
    assert np.all(departure < 5 * u)
    assert np.all(np.abs(table["Qx_corrected"] - table["Qx"]).to_numpy()[1:] > 20 * u[1:])

    (python,) = find_code_blocks("python")
    space = {}
    exec(compile(python, "apply.md", "exec"), space)
    np.testing.assert_allclose(space["correction"].corrected, table["Qx_corrected"], rtol=1e-15)
    np.testing.assert_allclose(space["correction"].u, table["Qx_corrected_u"], rtol=1e-15)


def test_documented_options_match_help(capsys):
    assert cli.main(["apply", "--help"]) == 0
    (table,) = re.findall(r"^## Options\n(.*?)^Terms", PAGE, re.MULTILINE | re.DOTALL)
    matches = set(re.findall(r"`(--[a-z-]+)", table))
    # The first cell of a row; the rest is prose.
    helped = set(re.findall(r"^\W+(--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))
    assert matches == helped - {"--accelerometer", "--output"}


# --- files ----------------------------------------------------------------------------------------


def test_round_trip_through_csv_and_parquet(folder, capsys):
    force = np.linspace(-39.0, 39.0, 157)
    y = indicated(QX, MODEL, np.outer(force, [1.0, 0.0, 0.0]))
    pl.DataFrame({"t": force * 0.1, "east": y}).write_parquet("in.parquet")
    pl.DataFrame({"t": force * 0.1, "east": y}).write_csv("in.csv")
    for source in ("in.parquet", "in.csv"):
        for target in ("out.csv", "out.parquet"):
            words = ["result.json", source, "--accelerometer", "Qx", "--input", "east"]
            assert run(*words, "-o", target, "--overwrite") == 0
            read = pl.read_csv if target.endswith("csv") else pl.read_parquet
            table = read(target)
            assert table.columns == ["t", "east", "east_corrected", "east_corrected_u"]
            np.testing.assert_array_equal(table["east"], y)
            np.testing.assert_allclose(table["east_corrected"], force, rtol=0, atol=1e-12)
    output = capsys.readouterr().out
    assert "157 rows of east" in output
    assert "Warning" not in output


def test_missing_seal_is_reported(folder, capsys):
    pl.DataFrame({"east": [1.0, 2.0]}).write_csv("in.csv")
    words = ["result.json", "in.csv", "--accelerometer", "Qx", "--input", "east", "-o", "out.csv"]
    remove_seal(Path("result.json"))
    assert run(*words) == 0
    assert "The file of the result has no seal" in " ".join(capsys.readouterr().out.split())


def test_si_unit_uses_site_gravity(folder):
    force = np.array([0.5, -3.0, 12.0])
    y = G * indicated(QX, MODEL, np.outer(force, [1.0, 0.0, 0.0]))
    pl.DataFrame({"Qx": y}).write_csv("in.csv")
    words = ["result.json", "in.csv", "--accelerometer", "Qx", "-o", "out.csv"]
    assert run(*words, "--unit", "m/s^2") == 0
    np.testing.assert_allclose(pl.read_csv("out.csv")["Qx_corrected"], G * force, atol=1e-11)


def test_input_cells_are_unchanged(folder):
    write_table('# made by hand\nnote;a\n"b; c";1.50\n# later\n;0.00100\n', "in.csv")
    assert run("result.json", "in.csv", "--accelerometer=Qx", "--input=a", "-o", "out.csv") == 0
    table = pl.read_csv("out.csv", infer_schema=False)
    assert table["a"].to_list() == ["1.50", "0.00100"]
    assert table["note"].to_list() == ["b; c", None]


#: Table of a German recorder.
GERMAN = "Pr\xfcfling 7\nQx;t\ng;s\n1,250;0,5\n-2,500;1,5\n3,000;2,5\n"


def test_decimal_commas_are_read_and_written(folder, capsys):
    Path("in.csv").write_bytes(GERMAN.encode("latin-1"))
    texts = ["--skip-lines=1", "--delimiter=;", "--decimal=,", "--encoding=latin-1", "--units-row"]
    for more in ([], texts):
        words = ["result.json", "in.csv", "--accelerometer=Qx", "--overwrite", *more]
        assert run(*words, "-o", "out.csv") == 0
        assert run(*words, "-o", "out.parquet") == 0
        report = " ".join(capsys.readouterr().out.split())
        assert "File format: names in line 2, a units row, semicolon-separated" in report
        lines = Path("out.csv").read_text(encoding="utf-8").splitlines()
        assert lines[0] == "Qx;t;Qx_corrected;Qx_corrected_u"
        assert [line.split(";")[0] for line in lines[1:]] == ["1,250", "-2,500", "3,000"]
        table = pl.read_parquet("out.parquet")
        expected = apply(make_result(), "Qx", [1.25, -2.5, 3.0]).corrected
        assert table["Qx"].to_list() == [1.25, -2.5, 3.0]
        assert table["Qx_corrected"].to_numpy() == pytest.approx(expected, abs=1e-15)
        for line, value in zip(lines[1:], expected, strict=True):
            assert float(line.split(";")[2].replace(",", ".")) == pytest.approx(value, abs=1e-15)
    assert run(*words, "--unit=mg", "-o", "out.csv") == 1
    assert "'mg' according to --unit" in capsys.readouterr().err


def test_rejects_negative_skip_lines(folder, capsys):
    words = ["result.json", "in.csv", "--accelerometer=Qx", "-o", "out.csv"]
    assert run(*words, "--skip-lines=-1") == 2
    assert "--skip-lines. Must be >= 0." in capsys.readouterr().err


def test_second_sheet_requires_choice_and_unit_row_is_skipped(folder):
    rows = [["East"], ["g"], [1.25], [-2.5], [3.0]]
    write_workbook(folder / "in.xlsx", {"before": rows[:2], "A": [["about"], *rows], "B": rows})
    words = ["result.json", "in.xlsx", "--accelerometer=Qx", "-o", "out.parquet", "--overwrite"]
    assert run(*words) == 1
    expected = apply(make_result(), "Qx", [1.25, -2.5, 3.0]).corrected
    for sheet in "AB":
        assert run(*words, "--sheet", sheet) == 0
        to_numpy = pl.read_parquet("out.parquet")["East_corrected"].to_numpy()
        np.testing.assert_array_equal(to_numpy, expected)


def test_missing_number_leaves_row_empty(folder, capsys):
    write_table("t,Qx\n0,1.0\n1,\n2,nan\n3,2.0\n")
    assert run("result.json", "data.csv", "--accelerometer", "Qx", "-o", "out.csv") == 0
    assert pl.read_csv("out.csv")["Qx_corrected"].is_null().to_list() == [False, True, True, False]
    assert "2 of these rows lack a number" in capsys.readouterr().out
    write_table("Qx,\nnan,\n", "none.csv")
    assert run("result.json", "none.csv", "--accelerometer", "Qx", "-o", "no.csv") == 1
    assert "no row " in capsys.readouterr().err
    assert not Path("no.csv").exists()


def test_unit_in_column_name_must_agree(folder, capsys):
    words = ["result.json", "data.csv", "--accelerometer=Qx", "--overwrite", "-o", "out.csv"]
    write_table("t,f (m/s^2)\n0,9.8\n1,\n")
    assert run(*words, "--input=f (m/s^2)", "--unit=m/s^2") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "1 of these rows lacks a number and remains empty" in out
    assert run(*words, "--input=f (m/s^2)") == 1
    error = " ".join(capsys.readouterr().err.split())
    assert "column 'f (m/s^2)' is in 'm/s^2' according to the file, but in 'g'" in error
    # With outputs, cross-axis forces are in g.
    options = [ApplyOptions(unit=unit, pendulous="P") for unit in ("mA", "mg")]
    assert _stated_units(["A", "P"], options[0]) == {"A": "mA", "P": "g"}
    assert _stated_units(["A", "P"], options[1]) == {"A": "mg", "P": "mg"}


def test_cross_axis_force_from_column_constant_or_accelerometer(folder, capsys):
    three, models = make_three()
    cs.write_result(three, folder / "three.json")
    rng = np.random.default_rng(8)
    force = rng.uniform(-20.0, 20.0, size=(50, 3))
    pl.DataFrame(
        {n.lower(): indicated(m, models[n], force) for n, m in MOUNTINGS.items()}
        | {"down": -force[:, 2], "north": force[:, 1]}
    ).write_csv("all.csv")
    words = ["three.json", "all.csv", "--accelerometer", "Qx", "--input", "qx"]
    words += ["-o", "out.csv", "--overwrite"]
    ways = (
        ["--pendulous", "down", "--output-axis", "north"],
        ["--others", "Qy=qy, Qz=qz"],
        ["--others", "Qy=qy", "--pendulous", "down"],
    )
    for way in ways:
        assert run(*words, *way) == 0
        got = pl.read_csv("out.csv")["qx_corrected"]
        np.testing.assert_allclose(got, force[:, 0], rtol=0, atol=1e-12)

    assert run(*words) == 2
    error = capsys.readouterr().err
    assert "K_IP, K_PP, delta_O of Qx need the specific force along its pendulous axis" in error
    assert "give --pendulous: a column, or a constant such as --pendulous '-1 g'" in error
    assert "K_OO, delta_P of Qx need the specific force along its output axis" in error
    assert run(*words, "--others", "Qz=qz") == 2
    assert "along its output axis" in capsys.readouterr().err
    assert run(*words, "--others", "Qy=qy, Qz=qz", "--pendulous", "down") == 2
    assert "is overdetermined" in capsys.readouterr().err

    level = force * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    pl.DataFrame({"qx": indicated(QX, models["Qx"], level), "o": level[:, 1]}).write_csv("all.csv")
    for constant in ("-1 g", "-1 ± 1e-3 g", f"{-G} m/s^2"):
        assert run(*words, "--pendulous", constant, "--output-axis", "o") == 0
        got = pl.read_csv("out.csv")["qx_corrected"]
        np.testing.assert_allclose(got, force[:, 0], rtol=0, atol=1e-12)
        # Only K_IP a_I + 2 K_PP a_P + delta_O, times 1e-3 g, is uncertain.
        slope = CROSS["K_IP"] * force[:, 0] - 2 * CROSS["K_PP"] + CROSS["delta_O"]
        expected = np.abs(slope) * (1e-3 if "±" in constant else 0.0)
        u = pl.read_csv("out.csv")["qx_corrected_u"]
        np.testing.assert_allclose(u, expected, rtol=0.01, atol=1e-15)


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--accelerometer", "Qz", "-o", "o.csv"], 2, "no accelerometer 'Qz'; it has Qx"),
        (["--accelerometer", "Qx", "-o", "data.csv"], 2, "is the input"),
        (["--accelerometer", "Qx", "-o", "./data.csv"], 2, "is the input"),
        (["--accelerometer", "Qx", "-o", "o.xlsx"], 2, "must end in one of .csv"),
        (["--accelerometer", "Qx", "-o", "no/o.csv"], 1, "cannot be written"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--input", "Qy"], 1, "no column 'Qy'"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--input", "who"], 1, "line 2: column 'who'"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--unit", "m"], 2, "--unit: 'm' is not a unit"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--pendulous", "down"], 2, "neither a column"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--pendulous", "-1"], 2, "has no unit"),
        (["--accelerometer", "Qx", "-o", "o.csv", "--others", "Qy"], 2, "not of the form"),
        (
            ["--accelerometer", "Qx", "-o", "o.csv", "--input", "other", "--others", "Qx=Qx"],
            2,
            "to be corrected; omit it here",
        ),
        (["--accelerometer", "Qx"], 2, "--output"),
    ],
)
def test_rejects_invalid_arguments(folder, capsys, words, status, message):
    text = "who,Qx,other\nme,1.0,2.0\n"
    write_table(text)
    assert run("result.json", "data.csv", *words) == status
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert Path("data.csv").read_text(encoding="utf-8") == text
    assert sorted(p.name for p in folder.iterdir()) == ["data.csv", "result.json"]


def test_only_accelerometer_of_result_needs_no_name(folder):
    write_table("east,north\n1.0,2.0\n")
    assert run("result.json", "data.csv", "--input", "east", "-o", "out.csv") == 0
    words = ["--accelerometer", "Qx", "--input", "east", "-o", "named.csv"]
    assert run("result.json", "data.csv", *words) == 0
    assert Path("out.csv").read_bytes() == Path("named.csv").read_bytes()


def test_ambiguous_column_requires_input_option(folder, capsys):
    write_table("east,north\n1.0,2.0\n")
    words = ["result.json", "data.csv", "--accelerometer", "Qx", "-o", "out.csv"]
    assert run(*words) == 2
    assert "--input; the file has east, north" in capsys.readouterr().err
    assert run(*words, "--output-axis", "north") == 0
    assert pl.read_csv("out.csv").columns[-1] == "east_corrected_u"
    assert run("result.json", "out.csv", *words[2:4], "--input", "east", "-o", "o.csv") == 2
    assert "already has a column 'east_corrected'" in capsys.readouterr().err


def test_row_beyond_turning_point_is_named_by_line(folder, capsys):
    result = make_result({"Qx": make_accelerometer({"K_I": 1.0, "K_III": -1e-4})})
    cs.write_result(result, folder / "result.json", overwrite=True)
    write_table("# x\nQx\n1.0\n39.0\n")
    assert run("result.json", "data.csv", "--accelerometer", "Qx", "-o", "out.csv") == 1
    error = capsys.readouterr().err
    assert (
        "data.csv, line 4: the indication of Qx cannot be corrected, because the indication is 39 g"
        in error
    )
    assert "has a turning point at 57.735 g, where the indication is 38.49 g" in error
    assert not Path("out.csv").exists()


def test_rejects_as_printed_without_force(folder, capsys):
    cs.write_result(make_result(model="as-printed"), folder / "result.json", overwrite=True)
    write_table("Qx\n1.0\n")
    words = ["result.json", "data.csv", "--accelerometer", "Qx", "-o", "out.csv"]
    assert run(*words) == 2
    assert "yield half the true K_II" in capsys.readouterr().err
    assert run(*words, "--force") == 0


def test_contradicted_result_requires_reason(folder, capsys):
    drives = [Jackknife(run="run1", value=1e-5, shift=1e-6, z=-8.0)]
    result = make_result({"Qx": make_accelerometer({"K_I": 1.0}, jackknife=drives)})
    write_table("Qx\n1.0\n")
    words = ["result.json", "data.csv", "--accelerometer", "Qx", "-o", "out.csv"]
    judge_result(result).write(folder / "result.json", overwrite=True)
    assert run(*words, "--force") == 1
    text = " ".join(capsys.readouterr().err.split())
    assert "the records contradict the result for Qx: Omitting run1 shifts K_II" in text
    assert not Path("out.csv").exists()
    judge_result(result, "run1 was on the old motor").write(folder / "result.json", overwrite=True)
    assert run(*words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "The misfit was accepted for this reason: run1 was on the old motor" in text


def test_rejects_result_with_undetermined_coefficient():
    nothing = make_coefficient("K_III", None, None, estimated=False)
    terms = make_accelerometer({"K_I": 1.0}).coefficients | {"K_III": nothing}

    def make_undetermined(symbol):
        finding = not_determined_finding(
            f"Qx.{symbol}", symbol, advice=" Add a run.", is_requested=True
        )
        return make_result({"Qx": make_accelerometer({}, coefficients=terms, findings=[finding])})

    with raises("not-determined", "K_III", "Add a run."):
        apply(make_undetermined("K_III"), "Qx", [1.0])
    # The correction does not include a drift during the calibration.
    assert apply(make_undetermined("K_F.trend"), "Qx", [1.0]).corrected[0] == pytest.approx(1.0)


# --- applied coefficients and their uncertainty ---------------------------------------------------


def test_undetermined_scale_factor_is_not_applied():
    accelerometer = make_accelerometer({"K_F": 0.005})
    nothing = make_coefficient("K_III", None, None, estimated=False)
    scale = make_coefficient("K_I", None, None, estimated=False)
    terms = accelerometer.coefficients | {"K_III": nothing, "K_I": scale}
    done = apply(make_result({"Qx": make_accelerometer({}, coefficients=terms)}), "Qx", [1.005])
    assert done.corrected[0] == pytest.approx(1.0, abs=1e-15)
    assert done.u[0] == 0.0
    assert done.notes == ("Qx: coefficients applied as estimated: K_F.",)
    assert "the result does not determine K_III, K_I" in done.warnings[0]
    assert "no value for K_I (scale factor). The correction uses 1 g/g" in done.warnings[1]
    # The same holds for a campaign in which K_I is not requested.
    (warning,) = apply(make_result({"Qx": accelerometer}), "Qx", [1.005]).warnings
    assert "The correction uses 1 g/g" in warning


def test_priors_are_applied_with_their_uncertainty():
    known = {"K_III": make_coefficient("K_III", 3e-6, 1e-7, estimated=False)}
    result = make_result({"Qx": make_accelerometer({"K_I": 1.0}, known=known)})
    done = apply(result, "Qx", [10.0 + 3e-3])
    assert done.corrected[0] == pytest.approx(10.0, abs=1e-12)
    assert done.u[0] == pytest.approx(1e-4 / (1 + 3 * 3e-6 * 100), rel=1e-9)
    assert done.notes == ("Qx: coefficients applied as estimated: K_I; from priors: K_III.",)


def test_result_contains_priors_of_campaign(tmp_path):
    cs.init(tmp_path)
    file = tmp_path / "campaign.toml"
    text = file.read_text(encoding="utf-8").replace('# K_III = "0', 'K_OO = "2e-6')
    file.write_text(text.replace("g/g^3", "g/g^2", 1), encoding="utf-8")
    parts = describe_instrument(cs.read_campaign(tmp_path).accelerometers["Qx"], ["K_F", "K_I"])
    assert parts["known"] == {"K_OO": make_coefficient("K_OO", 2e-6, 1e-5, estimated=False)}
    run_priors = found_of(**parts)
    assert run_priors.axes == list(QX.axes)
    assert AccelerometerResult.model_validate_json(run_priors.model_dump_json()) == run_priors


def test_correlated_errors_cancel():
    """K_F was estimated with K_PP held: only K_F + K_PP is determined."""
    line = BudgetLine(
        source="K_PP",
        kind="held",
        u=2e-6,
        unit="g/g^2",
        sensitivity=-1.0,
        contribution=2e-6,
        share=1.0,
    )
    accelerometer = make_accelerometer(
        {},
        coefficients={"K_F": make_coefficient("K_F", 0.005, math.hypot(2e-6, 1e-8))},
        known={"K_PP": make_coefficient("K_PP", 0.0, 2e-6, estimated=False)},
        budget={"K_F": [line]},
    )
    level, side = (
        apply(make_result({"Qx": accelerometer}), "Qx", [0.5], ApplyOptions(pendulous=p)).u[0]
        for p in (-1.0, 0.0)
    )
    assert level == pytest.approx(1e-8, rel=1e-6)
    assert side == pytest.approx(2e-6, rel=1e-4)


def test_inconsistent_correlations_do_not_give_zero_uncertainty():
    """K_F and K_I fully correlated, K_II with opposite signs: impossible correlations.

    The variance of a force at which contributions seemed to cancel was negative.
    """
    u = {"K_F": 1e-5, "K_I": 1e-5, "K_II": 1e-5}
    impossible = [[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]
    terms = {s: make_coefficient(s, TERMS[s].nominal, size) for s, size in u.items()}
    correlation = Correlation(terms=list(u), matrix=impossible)
    result = make_result(
        {"Qx": make_accelerometer({}, coefficients=terms, correlation=correlation)}
    )
    level = np.array([-1.0, 0.0, 1.0])
    products = np.stack([np.ones(3), level, level**2])
    sizes = np.array(list(u.values()))
    naive = np.einsum("in,ij,jn->n", products, impossible * np.outer(sizes, sizes), products)
    assert naive.min() < 0.0
    done = apply(result, "Qx", level)
    # Not below the bound for any correlation of the errors.
    assert (done.u >= np.abs(products).T @ sizes * (1.0 - 1e-12)).all()
    (warning,) = done.warnings
    assert "inconsistent" in warning


def test_uncertainty_matches_trials():
    """Compare u with the scatter of corrections for coefficients drawn from the covariance.

    With 2000 trials a standard deviation is known to 1/sqrt(4000) = 1.6 %; 8 % is 5 sigma.
    """
    u = {"K_F": 2e-6, "K_I": 5e-6, "K_II": 4e-7, "K_III": 3e-8}
    r = np.array([[1, 0.2, -0.9, 0], [0.2, 1, 0, -0.8], [-0.9, 0, 1, 0], [0, -0.8, 0, 1]])
    terms = {s: make_coefficient(s, v, u[s], dof=12.0 + 100 * u[s]) for s, v in MODEL.items()}
    shuffled = [2, 0, 3, 1]
    correlation = Correlation(
        terms=[*(list(MODEL)[k] for k in shuffled), "platform.drift.north"],
        matrix=np.pad(r[np.ix_(shuffled, shuffled)], (0, 1)).tolist(),
    )
    result = make_result(
        {"Qx": make_accelerometer({}, coefficients=terms, correlation=correlation)}
    )
    covariance = make_instrument(result, "Qx").covariance
    sd = np.array(list(u.values()))
    np.testing.assert_allclose(covariance, r * np.outer(sd, sd), rtol=1e-14)
    y = np.array([-30.0, -1.0, 0.0, 1.0, 30.0])
    done = apply(result, "Qx", y)
    assert done.dof == pytest.approx(12.0, abs=1e-3)
    drawn = np.random.default_rng(3).multivariate_normal(list(MODEL.values()), covariance, 2000)
    np.testing.assert_allclose(done.u, np.std(invert_cubics(drawn, y), axis=0), rtol=0.08)
    np.testing.assert_allclose(
        done.corrected, invert_cubics([list(MODEL.values())], y)[0], rtol=1e-12
    )


def invert_cubics(coefficients, y):
    """Return the forces (n, m) at which cubics with coefficients (n, 4) equal y (m,), by Newton."""
    bias, scale, square, cube = np.transpose(coefficients)[:, :, None]
    force = np.broadcast_to(y, (len(bias), y.size))
    for _ in range(6):
        indicated = bias + force * (scale + force * (square + force * cube))
        force = force - (indicated - y) / (scale + force * (2.0 * square + 3.0 * cube * force))
    return force


def test_force_beyond_calibrated_range_is_reported():
    result = make_result(rate=2 * math.pi)  # 2.5 m x (2 pi)^2 / g = 10.06 g
    assert apply(result, "Qx", [10.0, -10.1]).warnings == ()
    (warning,) = apply(result, "Qx", [40.0, math.nan]).warnings
    assert "reaches 40 g, but the calibration reached only 10.1 g" in warning


def test_readings_extend_calibrated_range():
    result = make_result(rate=2 * math.pi)
    reading = ReadingResult(
        name="arm", motion="arm", rate=14.0, value=-40.0, u=1e-6, residual=0.0, z=0.0
    )
    result.accelerometers["Qx"].readings.append(reading)
    assert apply(result, "Qx", [40.0]).warnings == ()


def test_results_of_earlier_versions_have_no_axes():
    three, _ = make_three()
    old = {
        n: accelerometer.model_copy(update={"axes": None})
        for n, accelerometer in three.accelerometers.items()
    }
    three = three.model_copy(update={"accelerometers": old})
    level = ApplyOptions(pendulous="-1 g", output_axis=0.0)
    assert apply(three, "Qx", [1.0], level).corrected.shape == (1,)
    with raises("missing-in-result", "Qx"):
        apply(three, "Qx", [1.0], ApplyOptions(others={"Qy": [0.0], "Qz": [1.0]}))


def test_error_in_python_names_sample(tmp_path):
    result = make_result({"Qx": make_accelerometer({"K_I": 1.0, "K_III": -1e-4})})
    with pytest.raises(ConvergenceError, match=r"sample 1 \(counted from 0\) of Qx"):
        apply(result, "Qx", [1.0, 50.0])
    pl.read_csv(io.StringIO("Qx\n1.0\n")).write_csv(tmp_path / "in.csv")
    done = apply_file(result, "Qx", str(tmp_path / "in.csv"), str(tmp_path / "out.csv"))
    assert done.at_one_g.indicated == done.low == done.high == 1.0
    assert done.most.correction == pytest.approx(1e-4, rel=1e-3)


@pytest.mark.parametrize("name", ["in.csv", "in.parquet", "in.h5", "in.mat"])
def test_record_formats_can_be_corrected(tmp_path, name):
    table = pl.DataFrame({"Qx": [1.0, 2.0, -3.0], "t": [0.0, 0.5, 1.0]})
    file = tmp_path / name
    if file.suffix == ".csv":
        table.write_csv(file)
    elif file.suffix == ".parquet":
        table.write_parquet(file)
    elif file.suffix == ".mat":
        savemat(file, table.to_dict())
    else:
        with h5py.File(file, "w") as store:
            for column in table:
                store[column.name] = column.to_numpy()
    result = make_result({"Qx": make_accelerometer({"K_I": 2.0})})
    apply_file(result, "Qx", file, tmp_path / "out.parquet", column="Qx")
    written_table = pl.read_parquet(tmp_path / "out.parquet")
    assert written_table["Qx_corrected"].to_list() == [0.5, 1.0, -1.5]
    assert written_table["t"].to_list() == [0.0, 0.5, 1.0]


def test_calibrated_output_unit_is_corrected_directly(tmp_path):
    """Counts with an offset of 33000 and 4000 per g equal the same forces in g."""
    ready = make_result({"Qx": make_accelerometer(MODEL)})
    nominal = NominalOutput(unit="count", sensitivity=4000.0, zero=33000.0)
    counting = make_result({"Qx": make_accelerometer(MODEL, nominal=nominal)})
    force = np.array([-1.0, 0.25, 0.999])
    plain = apply(ready, "Qx", force)
    counts = apply(counting, "Qx", 33000.0 + 4000.0 * force, ApplyOptions(unit="count"))
    assert counts.unit == "g"
    np.testing.assert_allclose(counts.corrected, plain.corrected, rtol=1e-13)
    np.testing.assert_allclose(counts.indicated, force, rtol=1e-13)
    pl.DataFrame({"n": 33000.0 + 4000.0 * force}).write_csv(tmp_path / "raw.csv")
    done = apply_file(
        counting,
        "Qx",
        tmp_path / "raw.csv",
        tmp_path / "done.csv",
        options=ApplyOptions(unit="count"),
    )
    assert (done.low, done.high) == (pytest.approx(-1.0), pytest.approx(0.999))
    np.testing.assert_allclose(pl.read_csv(done.path)["n_corrected"], plain.corrected, rtol=1e-13)
    # A unit of another or an unstated output is rejected.
    for one, unit, said in (
        (counting, "V", "'V' cannot be converted to count"),
        (ready, "count", "the result does not state a different output for Qx"),
    ):
        with pytest.raises(CampaignError, match=said):
            apply(one, "Qx", force, ApplyOptions(unit=unit))
