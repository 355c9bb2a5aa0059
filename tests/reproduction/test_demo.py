"""The demonstration: the methods recover the values of the paper's plan."""

import math
import re

import pytest
from raising import raises

from counterspin import cli
from counterspin.errors import CounterspinError
from counterspin.reproduction import plan
from counterspin.reproduction.demo import demo
from counterspin.reproduction.page import demonstration_plots


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory):
    return demo(tmp_path_factory.mktemp("demo") / "made" / "here")


def test_campaign_has_values_of_paper(demonstration):
    campaign = demonstration.campaign
    assert demonstration.truth == plan.TABLE_1
    assert campaign.gravity.value == plan.GRAVITY
    assert campaign.radius.value == plan.RADIUS
    assert campaign.noise.displacement == plan.SIGMA_DISPLACEMENT
    assert [run.rate for run in campaign.runs] == pytest.approx(plan.RATES, rel=1e-15)
    for run in campaign.runs:
        (ripple,) = campaign.simulation.truth.runs[run.name].spindle.ripples
        assert ripple.amplitude / run.rate == pytest.approx(plan.RIPPLE_RATIO, rel=1e-12)
        assert ripple.phase == pytest.approx(plan.RIPPLE_PHASE, rel=1e-15)
        assert run.duration * run.rate / (2 * math.pi) == pytest.approx(plan.N_STROBES)
    assert [
        run.parabola.strobes.time.size for run in demonstration.two_stage.second_stage.runs
    ] == [
        100,
        100,
        100,
    ]


def test_methods_recover_truth_and_printed_equations_half(demonstration):
    # Five standard uncertainties with a fixed seed: only an error fails.
    for method in (demonstration.joint, demonstration.two_stage.result):
        for symbol, coefficient in method.coefficients.items():
            if coefficient.estimated:
                assert abs(coefficient.value - demonstration.truth[symbol]) < 5 * coefficient.u, (
                    symbol
                )
    half = demonstration.as_printed.result.coefficients["K_II"]
    assert abs(half.value - demonstration.truth["K_II"] / 2) < 5 * half.u
    assert abs(half.value - demonstration.truth["K_II"]) > 100 * half.u


def test_joint_fit_has_smaller_uncertainty(demonstration):
    u = [m.coefficients["K_II"].u for m in (demonstration.joint, demonstration.two_stage.result)]
    assert u[0] < 8e-10
    assert u[1] > 4 * u[0]


def test_figure_shows_first_stage_minus_bias(demonstration):
    upper, *lower = demonstration_plots(demonstration)
    assert upper.title.startswith("The paper's plan: Qx")
    half_bias = 0.5 * demonstration.two_stage.result.coefficients["K_F"].value * plan.GRAVITY
    curves, strobes = upper.series[::2], upper.series[1::2]
    for run, curve, points, panel in zip(
        demonstration.two_stage.second_stage.runs, curves, strobes, lower, strict=True
    ):
        _, residuals = panel.series
        assert residuals.x == tuple(run.parabola.strobes.time)
        assert residuals.y == pytest.approx(1e3 * run.parabola.residuals)
        # The remainder grows with the fourth power of the rate: K_II R^2 w^4 / (4 g) t^2.
        rate = run.trajectory.spindle.rate
        k_ii = plan.TABLE_1["K_II"] * plan.RADIUS**2 * rate**4 / (4 * plan.GRAVITY)
        fitted = run.parabola.b2 - half_bias
        assert fitted == pytest.approx(k_ii, rel=0.05)
        assert curve.y == pytest.approx([fitted * t**2 for t in curve.x], abs=1e-9)
        every = dict(zip(run.parabola.strobes.time, run.parabola.residuals, strict=True))
        for t, y in zip(points.x, points.y, strict=True):
            assert y == pytest.approx(fitted * t**2 + every[t], abs=1e-9)
        # 100 strobes: the band of two standard deviations is correct within 25 %.
        spread = math.sqrt((run.parabola.residuals**2).mean())
        assert panel.series[0].high[0] == pytest.approx(2e3 * spread, rel=0.25)
        assert panel.y_range[1] > 1e3 * abs(run.parabola.residuals).max()
        assert (panel.y_range, panel.x_range) == (lower[0].y_range, upper.x_range)
        assert curve.colour == points.colour == residuals.colour


def test_command_writes_listed_files_and_can_be_repeated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["demo"]) == 0
    first_output = capsys.readouterr().out
    file_names = {path.name for path in (tmp_path / "counterspin-demo").iterdir()}
    assert file_names == {"campaign.toml", "run1.csv", "run2.csv", "run3.csv", "displacement.svg"}
    assert (
        "Wrote campaign.toml, 3 records and displacement.svg to counterspin-demo." in first_output
    )
    assert max(map(len, first_output.splitlines())) <= 80
    value = r"(19\.9|20\.0)\d+ ± \S+"
    assert re.search(rf"^K_II +20 +{value} +{value} +(9\.9|10\.0)\d+ ± ", first_output, re.M)
    assert cli.main(["demo"]) == 1
    assert "displacement.svg already exists; " in capsys.readouterr().err
    assert cli.main(["demo", "--overwrite"]) == 0
    assert capsys.readouterr().out == first_output


def test_figure_as_png(tmp_path):
    assert cli.main(["demo", "-o", str(tmp_path / "out"), "--figure", "png"]) == 0
    assert (tmp_path / "out" / "displacement.png").read_bytes().startswith(b"\x89PNG")


def test_existing_campaign_is_not_overwritten(tmp_path):
    (tmp_path / "campaign.toml").write_text("schema = 1\n")
    with raises("file-exists"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["campaign.toml"]


def test_existing_records_are_not_overwritten(tmp_path):
    (tmp_path / "run1.csv").write_text("measured")
    with raises("file-exists", "run1.csv"):
        demo(tmp_path, overwrite=True)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["measured"]


def test_rejects_file_as_output_folder(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(CounterspinError, match="taken is a file, not a folder"):
        demo(tmp_path / "taken")
