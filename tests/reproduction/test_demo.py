"""The demonstration: the paper's plan comes back as it went in, and is told as it is."""

import math
import re

import pytest

from counterspin import cli
from counterspin.errors import CounterspinError
from counterspin.reproduction import plan
from counterspin.reproduction.demo import demo
from counterspin.reproduction.demo_page import demonstration_figure, strobe_panels


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    return demo(tmp_path_factory.mktemp("demo") / "made" / "here")


def test_campaign_is_the_paper_s(shown):
    campaign = shown.campaign
    assert shown.truth == plan.TABLE_1
    assert campaign.gravity.value == plan.GRAVITY
    assert campaign.radius.value == plan.RADIUS
    assert campaign.noise.displacement == plan.SIGMA_DISPLACEMENT
    assert [run.rate for run in campaign.runs] == pytest.approx(plan.RATES, rel=1e-15)
    for run in campaign.runs:
        (ripple,) = run.truth.spindle.ripples
        assert ripple.amplitude / run.rate == pytest.approx(plan.RIPPLE_RATIO, rel=1e-12)
        assert ripple.phase == pytest.approx(plan.RIPPLE_PHASE, rel=1e-15)
        assert run.duration * run.rate / (2 * math.pi) == pytest.approx(plan.STROBES)
    assert [run.parabola.strobes.time.size for run in shown.two_stage.runs] == [100, 100, 100]


def test_both_methods_find_the_truth_and_the_printed_equations_half_of_it(shown):
    # Five standard uncertainties, for a fixed seed: only a mistake can fail this.
    for method in (shown.joint, shown.two_stage.result):
        for symbol, found in method.coefficients.items():
            if found.estimated:
                assert abs(found.value - shown.truth[symbol]) < 5 * found.u, symbol
    half = shown.as_printed.result.coefficients["K_II"]
    assert abs(half.value - shown.truth["K_II"] / 2) < 5 * half.u
    assert abs(half.value - shown.truth["K_II"]) > 100 * half.u


def test_joint_fit_is_worth_its_trouble(shown):
    u = [m.coefficients["K_II"].u for m in (shown.joint, shown.two_stage.result)]
    assert u[0] < 8e-10
    assert u[1] > 4 * u[0]


def test_panels_are_the_first_stage(shown):
    for panel, run in zip(strobe_panels(shown.two_stage.runs), shown.two_stage.runs, strict=True):
        b0, b1, b2 = run.parabola.coefficients
        expected = b0 + b1 * panel.time + b2 * panel.time**2
        assert panel.fitted == pytest.approx(expected, abs=1e-9)
        assert panel.error - panel.fitted == pytest.approx(panel.residual, abs=1e-9)
        # 100 strobes: the band of one standard deviation is right within a quarter.
        assert panel.sigma == pytest.approx(math.sqrt((panel.residual**2).mean()), rel=0.25)
    figure = demonstration_figure(shown)
    assert figure.axes[0].get_title(loc="left") == "The paper's plan: Qx"


def test_command_writes_what_it_says_and_may_be_repeated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["demo"]) == 0
    first = capsys.readouterr().out
    written = {path.name for path in (tmp_path / "counterspin-demo").iterdir()}
    assert written == {"campaign.toml", "run1.csv", "run2.csv", "run3.csv", "displacement.svg"}
    assert "Wrote campaign.toml, 3 records and displacement.svg to counterspin-demo." in first
    assert max(map(len, first.splitlines())) <= 80
    value = r"(19\.9|20\.0)\d+ ± \S+"
    assert re.search(rf"^K_II +20 +{value} +{value} +(9\.9|10\.0)\d+ ± ", first, re.M)
    assert cli.main(["demo"]) == 0
    assert capsys.readouterr().out == first


def test_figure_as_png(tmp_path):
    assert cli.main(["demo", "-o", str(tmp_path / "out"), "--figure", "png"]) == 0
    assert (tmp_path / "out" / "displacement.png").read_bytes().startswith(b"\x89PNG")


def test_another_campaign_is_left_alone(tmp_path):
    (tmp_path / "campaign.toml").write_text("schema = 1\n")
    with pytest.raises(CounterspinError, match=r"is another campaign, .* choose another folder"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["campaign.toml"]


def test_a_file_in_the_place_of_the_folder(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(CounterspinError, match="taken: cannot be used"):
        demo(tmp_path / "taken")
