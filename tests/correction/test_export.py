"""Exports read by independent readers; IEEE Std 1293 normalisation by finite differences."""

import csv

import fastexcel
import numpy as np
import pytest
import results as by_hand
import yaml
from raising import raises
from scipy.io import loadmat

import counterspin as cs
from counterspin.cli import main
from counterspin.correction.export import coefficient_table, normalise
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.monitoring.result import NoiseResult

MATRIX = np.array([[0.996, 0.0, 0.0], [-0.003, 1.003, 0.0], [0.006, -0.002, 0.994]])
BIAS = np.array([0.0102, -0.0098, 0.0351])
GRAVITY = 9.81


def make_result(**parts):
    """Return a result with correlated K_F, K_I and K_II, and a prior K_OO that affects K_II."""
    correlation = [[1.0, 0.3, -0.2], [0.3, 1.0, 0.5], [-0.2, 0.5, 1.0]]
    moved = {"source": "K_OO", "kind": "stated", "u": 2e-6, "unit": "g/g^2", "sensitivity": 0.3}
    accelerometer = by_hand.make_accelerometer_result(
        coefficients={
            "K_F": by_hand.make_coefficient(0.005, 1e-6, "g", dof=40.0),
            "K_I": by_hand.make_coefficient(1.2, 1e-3, "g/g", dof=30.0),
            "K_II": by_hand.make_coefficient(3e-5, 2e-6, "g/g^2", dof=20.0),
        },
        known={"K_OO": {"value": 1e-6, "u": 2e-6, "unit": "g/g^2", "estimated": False}},
        correlation={"terms": ["K_F", "K_I", "K_II"], "matrix": correlation},
        budget={"K_II": [moved | {"contribution": 6e-7, "share": 0.09}]},
        **parts.pop("accelerometer", {}),
    )
    return by_hand.make_bare_result(accelerometers={"Qx": accelerometer}, **parts)


def make_triad_result(**changes):
    """Return a result with a triad X, Y, Z."""
    triad = {"accelerometers": ["X", "Y", "Z"], "parameters": {}, "matrix": MATRIX.tolist()}
    triad |= {"bias": BIAS.tolist(), "u_matrix": (1e-5 * np.eye(3)).tolist()} | changes
    bias = {"K_F": by_hand.make_coefficient(0.01, 1e-6, "g")}
    accelerometers = {name: by_hand.make_accelerometer_result(coefficients=bias) for name in "XYZ"}
    inputs = {"gravity": GRAVITY, "latitude": 0.8, "radius": 2.5}
    return by_hand.make_bare_result(accelerometers=accelerometers, inputs=inputs, triad=triad)


def test_normalised_covariance_matches_finite_differences():
    table = coefficient_table(make_result())
    normalised = normalise(table, make_result())
    assert table.symbols == ("K_F", "K_I", "K_II", "K_OO")
    assert normalised.symbols == ("K0", "K1", "K2", "Koo")
    # The prior of K_OO is correlated with the estimate that it affects: sensitivity times u^2.
    assert table.covariance[2, 3] == pytest.approx(0.3 * 2e-6**2)

    def normalise_ieee(k):
        return np.array([k[0] / k[1], k[1], k[2] / k[1], k[3] / k[1]])

    steps = 1e-3 * np.abs(table.values)
    slopes = [
        (normalise_ieee(table.values + step) - normalise_ieee(table.values - step)) / (2 * size)
        for size, step in zip(steps, np.diag(steps), strict=True)
    ]
    jacobian = np.array(slopes).T
    assert normalised.values == pytest.approx(normalise_ieee(table.values))
    u = np.sqrt(np.diag(normalised.covariance))
    expected = jacobian @ table.covariance @ jacobian.T
    assert normalised.covariance / np.outer(u, u) == pytest.approx(
        expected / np.outer(u, u), abs=1e-5
    )
    of_k_ii, of_k_i = 2e-6 / 1.2, 3e-5 / 1.2**2 * 1e-3
    expected = normalised.covariance[2, 2] ** 2 / (of_k_ii**4 / 20 + of_k_i**4 / 30)
    assert normalised.dof[2] == pytest.approx(expected)
    assert normalised.dof[1] == pytest.approx(30.0)


def test_k1_is_in_output_unit():
    nominal = {"unit": "mA", "sensitivity": 1.25, "zero": 4.0}
    of_output = make_result(accelerometer={"nominal": nominal})
    table = normalise(coefficient_table(of_output), of_output)
    assert (table.values[1], table.units[1]) == (pytest.approx(1.5), "mA/g")
    assert table.covariance[1, 1] ** 0.5 == pytest.approx(1.25e-3)


@pytest.mark.parametrize("normalisation", ["none", "ieee"])
def test_exported_files_round_trip(normalisation, tmp_path):
    for ending in (".csv", ".xlsx", ".mat"):
        cs.export(make_result(title="a < b"), tmp_path / f"a{ending}", normalisation=normalisation)
    table = coefficient_table(make_result())
    if normalisation == "ieee":
        table = normalise(table, make_result())
    u = np.sqrt(np.diag(table.covariance))
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["coefficient"] for row in rows] == [*table.symbols]
    assert [float(row["value"]) for row in rows] == table.values.tolist()
    covariance = [[float(row[f"cov {name}"]) for name in table.names] for row in rows]
    assert covariance == table.covariance.tolist()

    book = fastexcel.read_excel(tmp_path / "a.xlsx")
    assert book.sheet_names == ["coefficients", "covariance", "result"]
    sheet = book.load_sheet("coefficients").to_polars()
    assert sheet["u"].to_list() == u.tolist()
    assert sheet["origin"].to_list() == ["estimated"] * 3 + ["prior"]
    matrix = book.load_sheet("covariance").to_polars()[:, 1:]
    assert matrix.columns == table.names
    assert matrix.to_numpy() == pytest.approx(table.covariance, rel=1e-15)
    about = dict(book.load_sheet("result", header_row=None).to_polars().iter_rows())
    assert about["title"] == "a < b"

    content = loadmat(tmp_path / "a.mat", simplify_cells=True)["counterspin"]
    assert content["coefficient"].tolist() == [*table.symbols]
    assert content["value"].tolist() == table.values.tolist()
    assert content["covariance"].tolist() == table.covariance.tolist()
    assert content["dof"][3] == np.inf
    assert content["result"]["gravity"] == 9.8066


def test_triad_exports_match_psins_ros_and_kalibr(tmp_path):
    force = np.array([0.3, -0.5, 0.8]) * GRAVITY
    raw = (np.linalg.inv(MATRIX) @ (force / GRAVITY) + BIAS) * GRAVITY
    triad = make_triad_result()
    cs.export(triad, tmp_path / "a.mat", form="psins")
    clbt = loadmat(tmp_path / "a.mat", simplify_cells=True)["clbt"]
    step = 0.01  # imuclbt.m: velocity increments vm = Ka*vm - db*ts
    assert (clbt["Ka"] @ (raw * step) - clbt["db"] * step) / step == pytest.approx(force)
    cs.export(triad, tmp_path / "a.yaml", form="ros")
    ros = yaml.safe_load((tmp_path / "a.yaml").read_text())
    assert np.reshape(ros["SM"], (3, 3)) @ raw - ros["bias"] == pytest.approx(force)
    cs.export(triad, tmp_path / "b.yaml", form="kalibr", noise=(2e-3, 3e-5))
    kalibr = yaml.safe_load((tmp_path / "b.yaml").read_text())
    m = np.array(kalibr["accelerometers"]["M"])
    assert m @ force + BIAS * GRAVITY == pytest.approx(raw)
    assert np.triu(m, 1) == pytest.approx(0.0)
    assert kalibr["accelerometer_noise_density"] == 2e-3
    assert kalibr["accelerometer_random_walk"] == 3e-5
    cs.export(triad, tmp_path / "c.mat")
    exported = loadmat(tmp_path / "c.mat", simplify_cells=True)["counterspin"]["triad"]
    assert exported["matrix"] == pytest.approx(MATRIX)
    cs.export(triad, tmp_path / "c.xlsx")
    sheet = fastexcel.read_excel(tmp_path / "c.xlsx").load_sheet("triad").to_polars()
    assert sheet[:, 1:].to_numpy() == pytest.approx(np.column_stack([BIAS, MATRIX]))


@pytest.mark.parametrize(
    ("given", "name", "options", "message"),
    [
        (make_result(), "a.txt", {}, "must end in one of .csv, .xlsx, .mat"),
        (make_triad_result(), "a.csv", {"form": "psins"}, "must end in .mat"),
        (make_triad_result(), "a.yaml", {"form": "ros", "normalisation": "ieee"}, "does not apply"),
        (
            make_triad_result(),
            "a.yaml",
            {"form": "kalibr"},
            "`noise` is required for the format kalibr",
        ),
        (make_result(), "a.yaml", {"form": "ros"}, "the result has none"),
        (make_result(model="as-printed"), "a.csv", {}, "half the true K_II"),
    ],
)
def test_rejects_incompatible_request(given, name, options, message, tmp_path):
    with pytest.raises(CampaignError, match=message):
        cs.export(given, tmp_path / name, **options)
    assert not (tmp_path / name).exists()


def test_rejects_contradicted_and_undetermined_results(tmp_path):
    contradicted = make_result(state="contradicted", accelerometer={"state": "contradicted"})
    with raises("contradicted", "Qx"):
        cs.export(contradicted, tmp_path / "a.csv")
    open_ = make_triad_result(
        matrix=None, bias=None, why_no_matrix="The poses do not determine angle."
    )
    with pytest.raises(RecordError, match="do not determine angle"):
        cs.export(open_, tmp_path / "a.yaml", form="ros")


@pytest.mark.parametrize("ending", [".csv", ".xlsx", ".mat", ".yaml"])
def test_only_earlier_export_is_overwritten(ending, tmp_path):
    path, options = tmp_path / f"a{ending}", {"form": "ros"} if ending == ".yaml" else {}
    cs.export(make_triad_result(), path, **options)
    content = path.read_bytes()
    with pytest.raises(CounterspinError, match="use `overwrite=True`"):
        cs.export(make_triad_result(), path, **options)
    cs.export(make_triad_result(), path, overwrite=True, **options)
    assert path.read_bytes() == content
    path.write_text("a record")
    with raises("file-exists", "export"):
        cs.export(make_triad_result(), path, overwrite=True, **options)


def make_noise(**components):
    """Return the noise of a column, by component: value, upper limit."""
    sizes = {
        name: {"value": value, "low": 0.0, "high": high, "unit": ""}
        for name, (value, high) in components.items()
    }
    counts = dict.fromkeys(("rows", "outliers", "filled", "gaps"), 0)
    numbers = dict.fromkeys(("sampling_rate", "seconds", "drift", "u_drift"), 1.0)
    lists = {name: [] for name in ("lines", "allan", "spectrum", "remarks")}
    texts = {"name": "X", "column": "x", "observable": "specific_force", "in_g": False}
    return texts | counts | numbers | lists | {"components": sizes, "resolution": None}


def test_command_uses_largest_noise_and_upper_limits(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    signals = [
        make_noise(acceleration=(2e-3, 3e-3), bias_walk=(None, 5e-5)),
        make_noise(acceleration=(1e-3, 4e-3), bias_walk=(4e-5, 9e-5)),
    ]
    noise = {"record": "rest.csv", "checksum": None, "gravity": GRAVITY, "unused": [], "table": ""}
    NoiseResult.model_validate(noise | {"signals": signals}).write("noise.json")
    make_triad_result().write("triad.json")
    words = ["export", "triad.json", "-o", "imu.yaml", "--form", "kalibr"]
    assert main(words) == 2
    assert "--noise is required" in capsys.readouterr().err
    assert main([*words, "--noise", "noise.json"]) == 0
    assert capsys.readouterr().out == "Wrote imu.yaml.\n"
    kalibr = yaml.safe_load((tmp_path / "imu.yaml").read_text())
    assert kalibr["accelerometer_noise_density"] == 2e-3
    assert kalibr["accelerometer_random_walk"] == 5e-5
