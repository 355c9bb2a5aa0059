"""Conversions of a result against its numbers and other packages."""

import math
import pickle

import matplotlib as mpl
import numpy as np
import polars as pl
import pytest
from campaigns import SMALL, replace_parts, write_description
from raising import raises
from results import make_qx_result as made_by_hand

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result, read_result
from counterspin.campaign.description import read_campaign
from counterspin.errors import CounterspinError
from counterspin.reports.publication import MAX_CELL_LINES
from counterspin.simulation.simulate import simulate

mpl.use("Agg")

TILTING = replace_parts(
    SMALL,
    (
        '[model]\nassume = "all"\n',
        '[model]\nassume = "all"\n'
        'terms = ["K_F", "K_II", "platform.tilt.north"]\n\n[model.priors]\n'
        '"platform.tilt.north" = "0 ± 0.5 arcsec"\n',
    ),
    ('scale_factor = "0.999 g/g"', 'scale_factor = "0.999 ± 1e-5 g/g"'),
    ('"9.8066 m/s^2"', '"9.8066 ± 1e-2 m/s^2"'),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("notebook")
    simulate(write_description(where, TILTING, "plan.toml"), where / "records")
    return where / "records"


@pytest.fixture(scope="module")
def result(folder):
    return calibrate(folder)


def test_coefficient_has_field_notation(result):
    c = made_by_hand().accelerometers["Qx"].coefficients["K_II"]
    assert str(c) == repr(c) == "27.0000(10) ug/g^2"
    prior = c.model_copy(update={"estimated": False})
    assert str(prior) == "27.0000(10) ug/g^2 (prior, not determined)"
    assert str(c.model_copy(update={"value": None})) == "not determined"


def test_interval_uses_student_t():
    from scipy import stats

    c = made_by_hand().accelerometers["Qx"].coefficients["K_II"]
    low, high = c.interval(0.99)
    half = stats.t.ppf(0.995, c.dof) * c.u
    assert (low, high) == pytest.approx((c.value - half, c.value + half), rel=1e-12)
    for coverage in (0.0, 1.0, math.nan):
        with pytest.raises(ValueError, match="between 0 and 1"):
            c.interval(coverage)
    with pytest.raises(ValueError, match="do not determine"):
        c.model_copy(update={"value": None, "estimated": False}).interval()


def test_coefficients_are_accessed_by_name(result):
    assert result["Qx.K_F"] is result.coefficient("Qx.K_F")
    assert result["slow.platform.tilt.north"].unit == "rad"
    names = result._ipython_key_completions_()
    assert [result[name] for name in names]
    assert {"Qx.K_F", "Qx.K_II", "slow.platform.tilt.north"} <= set(names)
    with pytest.raises(KeyError, match=r"Qx\.K_X; the terms are Qx\.K_F"):
        result["Qx.K_X"]


def test_table_value_and_text_agree_in_same_unit(result):
    """Table numbers equal `in_units`, and the text shows the same numbers."""
    for row in result.table().iter_rows(named=True):
        owner = f"{row['owner']}." if row["owner"] else ""
        c = result[f"{owner}{row['term']}"]
        shown = c.in_units()
        assert (shown.value, shown.u, shown.unit) == (row["value"], row["u"], row["unit"])
        assert f" {shown.unit}" in str(c)
    c = result["Qx.K_II"]
    assert c.in_units("g/g^2").value == c.value
    assert c.in_units("ug/g^2").u == pytest.approx(1e6 * c.u, rel=1e-15)
    with pytest.raises(ValueError, match="rad"):
        c.in_units("rad")


def test_repr_is_short(result, folder):
    campaign = read_campaign(folder)
    assert repr(campaign) == f"<campaign {campaign.title!r}: Qx, Qy; 3 runs, 0 readings>"
    own = repr(result.accelerometers["Qx"]).splitlines()
    assert own[0].startswith("Accelerometer, ")
    assert len(own) == 1 + len(result.accelerometers["Qx"].coefficients)


def test_si_value_uses_gravity_of_result(result):
    c = result.coefficient("Qx.K_F")
    si = c.to_si()
    assert si.value == pytest.approx(c.value * 9.8066, rel=1e-15)
    assert si.unit.plain_text == "m s^-2"
    # An uncertain g affects K_F in g but not in m/s^2.
    assert si.u < 0.9 * c.u * 9.8066
    assert c.to_si(9.8066).u == pytest.approx(c.u * 9.8066, rel=1e-15)
    alone = type(c)(value=c.value, u=c.u, unit="g", estimated=True)
    with pytest.raises(ValueError, match="gravity"):
        alone.to_si()


def test_text_of_large_result_is_short(result):
    text = repr(result)
    assert str(result) == text
    assert len(text.split("\n")) <= MAX_CELL_LINES
    assert "Qx.K_II" in text
    assert str(result.coefficient("Qx.K_II")) in text
    many = {f"a{i}": result.accelerometers["Qx"] for i in range(40)}
    text = repr(result.model_copy(update={"accelerometers": many}))
    assert len(text.split("\n")) == MAX_CELL_LINES
    assert "more coefficients" in text


def test_notebook_repr_has_html_and_markdown(result):
    html, markdown = result._repr_html_(), result._repr_markdown_()
    assert "K<sub><i>_</i>II</sub> of Qx" in html
    assert "prefers-color-scheme: dark" in html
    assert "<script" not in html
    assert "http" not in html
    assert "of Qx" in markdown
    assert "<script>" not in result.model_copy(update={"title": "<script>"})._repr_html_()


def test_covariance_contains_all_coefficients(result):
    covariance = result.covariance
    assert "Qx.K_F" in covariance.terms
    assert "Qy.K_II" in covariance.terms
    assert any(term.startswith("slow.platform.tilt") for term in covariance.terms)
    size = len(covariance.terms)
    assert covariance.matrix.shape == (size, size) == (len(covariance.units),) * 2
    frame = covariance.frame()
    assert frame["term"].to_list() == list(covariance.terms)
    correlation = result.correlation.frame()
    u = {term: result.coefficient(term).u for term in covariance.terms}
    for term in covariance.terms:
        assert matrix_element(frame, term, term) == pytest.approx(u[term] ** 2, rel=1e-12)
    a, b = "Qx.K_F", "slow.platform.tilt.north"
    r = matrix_element(frame, a, b) / (u[a] * u[b])
    assert r == pytest.approx(matrix_element(correlation, a, b), rel=1e-12)
    own = result.accelerometers["Qx"].correlation.frame()
    assert matrix_element(own, "K_F", "K_II") == pytest.approx(
        matrix_element(correlation, "Qx.K_F", "Qx.K_II"), rel=1e-9
    )
    # Both accelerometers share the uncertain gravity.
    assert abs(matrix_element(correlation, "Qx.K_F", "Qy.K_F")) > 1e-3


def matrix_element(frame, row, column):
    """Return an element of a matrix by the names of its row and column."""
    return frame.filter(pl.col("term") == row)[column].item()


def test_two_stage_result_without_covariance_raises(folder):
    two_stage = calibrate(folder, method="two-stage")
    assert two_stage.covariance is None
    with raises("missing-in-result"):
        two_stage.to_uncertainties()


def test_table_has_row_per_coefficient(result):
    table = result.table()
    owner, term = pl.col("owner"), pl.col("term")
    k_ii = table.row(by_predicate=(owner == "Qx") & (term == "K_II"), named=True)
    c = result.coefficient("Qx.K_II")
    assert k_ii["value"] == pytest.approx(1e6 * c.value)
    assert k_ii["unit"] == "ug/g^2"
    assert (k_ii["low"], k_ii["high"]) == pytest.approx([1e6 * end for end in c.interval()])
    prior = table.row(by_predicate=owner == "slow", named=True)
    assert prior["term"] == "platform.tilt.north"
    assert prior["unit"] == "arcsec"
    same = result.table("pandas")
    assert same["u"].tolist() == table["u"].to_list()
    assert list(same.columns) == table.columns
    with pytest.raises(ValueError, match="polars or pandas"):
        result.table("sql")


def test_other_packages_have_same_correlations(result):
    uncertainties = pytest.importorskip("uncertainties")
    package = pytest.importorskip("GTC")
    covariance = result.covariance
    ours, theirs, third = covariance.frame(), result.to_uncertainties(), result.to_gtc()
    for name, one in theirs.items():
        assert one.n == result.coefficient(name).value
        assert one.s == pytest.approx(math.sqrt(matrix_element(ours, name, name)), rel=1e-9)
        assert third[name].u == pytest.approx(
            math.sqrt(matrix_element(ours, name, name)), rel=1e-12
        )
    a, b = "Qx.K_F", "Qx.K_II"
    variance = (
        matrix_element(ours, a, a) + matrix_element(ours, b, b) + 2.0 * matrix_element(ours, a, b)
    )
    assert (theirs[a] + theirs[b]).s == pytest.approx(math.sqrt(variance), rel=1e-9)
    assert (third[a] + third[b]).u == pytest.approx(math.sqrt(variance), rel=1e-9)
    matrix = uncertainties.covariance_matrix(list(theirs.values()))
    np.testing.assert_allclose(
        matrix, covariance.matrix, rtol=1e-6, atol=1e-9 * covariance.matrix.max()
    )
    assert package.get_correlation(third[a], third[b]) == pytest.approx(
        matrix_element(result.correlation.frame(), a, b)
    )


def test_missing_package_is_named(result, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "GTC", None)
    with pytest.raises(CounterspinError, match="pip install GTC"):
        result.to_gtc()


def test_residuals_are_returned_as_frame(result):
    residuals = result.residuals("Qx")
    assert residuals["accelerometer"].unique().to_list() == ["Qx"]
    assert residuals["unit"].unique().to_list() == ["m"]
    for (run,), rows in residuals.group_by("run"):
        error, fitted, residual = (
            rows[name].to_numpy() for name in ("error", "fitted", "residual")
        )
        rounding = 8.0 * np.finfo(float).eps * np.abs(error).max()
        np.testing.assert_allclose(fitted + residual, error, rtol=0, atol=rounding)
        trace = result.accelerometers["Qx"].traces[run]
        assert rows.height == trace.rows
        assert math.sqrt(np.mean(residual**2)) == pytest.approx(
            trace.rms, rel=5e-4
        )  # it has four digits
        whitened = rows["whitened"].drop_nulls()
        assert whitened.std() == pytest.approx(1.0, abs=5.0 / math.sqrt(len(whitened)))
    fast = result.residuals("Qy", "fast")
    assert fast["run"].unique().to_list() == ["fast"]
    with pytest.raises(KeyError, match="Qx in slow"):
        result.residuals("Qz")


def test_residuals_are_not_stored_in_file(result, tmp_path):
    result.write(tmp_path / "result.json")
    again = read_result(tmp_path / "result.json")
    assert again == result
    assert again.coefficient("Qx.K_F").to_si() == result.coefficient("Qx.K_F").to_si()
    with pytest.raises(CounterspinError, match="result files do not store them"):
        again.residuals()
    pickled = pickle.dumps(result)
    assert len(pickled) < 2 * len(pickle.dumps(again))
    assert pickle.loads(pickled) == result


@pytest.mark.parametrize(
    ("plot", "pictures"),
    [
        (Result.plot_residuals, 3),
        (Result.plot_spectrum, 3),
        (Result.plot_budget, 1),
        (Result.plot, 3),
    ],
)
def test_plots_are_drawn_on_given_axes(result, plot, pictures):
    import matplotlib.pyplot as plt

    drawn = plot(result, "Qy")
    assert len(drawn) in (1, pictures)
    assert all(axes.has_data() for axes in drawn)
    assert "Qy" in drawn[0].get_title(loc="left")
    _, own = plt.subplots(len(drawn), 1)
    assert plot(result, "Qy", axes=own) == list(np.atleast_1d(own))
    assert mpl.rcParams["axes.spines.top"]  # the report style applies only during drawing
    _, too_many = plt.subplots(len(drawn) + 1, 1)
    with pytest.raises(ValueError, match="axes were given for"):
        plot(result, "Qy", axes=too_many)
    plt.close("all")


def test_unknown_coefficient_error_lists_names(result):
    with pytest.raises(KeyError, match=r"Qx\.K_IX; the terms are .*Qx\.K_II.*slow\.platform\.tilt"):
        result.coefficient("Qx.K_IX")


def test_plot_without_data_raises(result):
    with pytest.raises(CounterspinError, match="does not contain"):
        result.plot_budget("Qx", "K_III")
    with pytest.raises(KeyError, match="the accelerometers are Qx, Qy"):
        result.plot_residuals("Qz")


def test_rejects_damaged_correlation(result):
    shorter = result.correlation.model_copy(update={"matrix": result.correlation.matrix[1:]})
    faults = result.model_copy(update={"correlation": shorter}).validation_errors()
    assert any("is not one of" in fault for fault in faults)


def test_removed_accelerometer_is_not_in_covariance(result):
    alone = {"Qy": result.accelerometers["Qy"]}
    covariance = result.model_copy(update={"accelerometers": alone}).covariance
    assert matrix_element(covariance.frame(), "Qy.K_F", "Qy.K_II") == matrix_element(
        result.covariance.frame(), "Qy.K_F", "Qy.K_II"
    )
    assert not any(term.startswith("Qx.") for term in covariance.terms)
