"""The figure: what it says, and that it is the same file every time."""

import subprocess
import sys

import numpy as np
import pytest

from counterspin.errors import CounterspinError
from counterspin.reports.figure import StrobePanel, displacement_figure, save

PAPER_RATES = (np.pi / 2, np.pi, 2 * np.pi)


def panels():
    """Return the paper's plan: 100 strobes a run, 10 mm of noise, 5.03 mg of bias."""
    rng = np.random.default_rng(4)
    made = []
    for index, rate in enumerate(PAPER_RATES):
        time = (np.pi / 2 + 2 * np.pi * np.arange(100)) / rate
        noise = 0.01 * rng.standard_normal(100)
        parabola = 0.02468 * time**2 + 2.7e-5 * 6.25 * rate**4 / 39.2 * time**2
        made.append(
            StrobePanel(f"run{index + 1}", rate, time, parabola + noise, parabola, noise, 0.01)
        )
    return made


@pytest.fixture(scope="module")
def figure():
    return displacement_figure(panels(), title="Qx")


def test_svg_says_what_is_drawn(figure, tmp_path):
    save(figure, tmp_path / "figure.svg")
    svg = (tmp_path / "figure.svg").read_text(encoding="utf-8")
    assert svg.rstrip().endswith("</svg>")
    for label in (
        ">Qx<",
        "displacement error / m",
        "residual / mm",
        "time / s",
        "run1, 1.5708 rad/s",
        "run2, 3.1416 rad/s",
        "run3, 6.2832 rad/s",
        "± 2 standard deviations",
    ):
        assert label in svg
    assert "<dc:date>" not in svg


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_same_data_give_the_same_bytes(ending, tmp_path):
    files = [tmp_path / f"{name}.{ending}" for name in "ab"]
    for file in files:
        save(displacement_figure(panels()), file)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(tmp_path.iterdir()) == files


def test_residual_axes_share_one_scale_that_holds_every_residual(figure):
    _, *lower = figure.axes
    assert len(lower) == len(PAPER_RATES)
    largest = 1e3 * max(np.max(np.abs(panel.residual)) for panel in panels())
    assert {axes.get_ylim() for axes in lower} == {lower[0].get_ylim()}
    assert lower[0].get_ylim()[1] > largest
    assert lower[0].get_ylim()[0] < -largest


def test_curve_is_the_fitted_parabola(figure):
    curve = figure.axes[0].lines[0]
    panel = panels()[0]
    at_strobes = np.interp(panel.time, curve.get_xdata(), curve.get_ydata())
    # A chord of a parabola misses it by b2 h^2/4 at most.
    step = np.ptp(panel.time) / 199
    b2 = 0.02468 + 2.7e-5 * 6.25 * PAPER_RATES[0] ** 4 / 39.2
    assert np.max(np.abs(at_strobes - panel.fitted)) < 1.001 * b2 * step**2 / 4


def test_every_strobe_is_in_the_residuals(figure):
    for axes, panel in zip(figure.axes[1:], panels(), strict=True):
        drawn = axes.lines[-1]
        np.testing.assert_array_equal(drawn.get_xdata(), panel.time)
        np.testing.assert_allclose(drawn.get_ydata(), 1e3 * panel.residual)


def test_one_run_without_noise_is_drawn(tmp_path):
    time = np.linspace(1.0, 50.0, 12)
    flat = np.zeros(12)
    panel = StrobePanel("still", -1.0, time, time**2, time**2, flat, 0.0)
    save(displacement_figure([panel]), tmp_path / "still.png")
    assert (tmp_path / "still.png").read_bytes().startswith(b"\x89PNG")


def test_other_endings_are_refused(figure, tmp_path):
    with pytest.raises(CounterspinError, match=r"figure\.gif: a figure is written as \.svg, \.png"):
        save(figure, tmp_path / "figure.gif")
    assert list(tmp_path.iterdir()) == []


def test_failure_leaves_nothing_behind(figure, tmp_path, monkeypatch):
    def full(part, **_):
        part.write_text("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(figure, "savefig", full)
    with pytest.raises(CounterspinError, match="No space left on device"):
        save(figure, tmp_path / "figure.svg")
    assert list(tmp_path.iterdir()) == []


def test_settings_of_the_user_s_own_figures_are_left_alone():
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    displacement_figure(panels())
    assert dict(mpl.rcParams) == before


def test_matplotlib_is_loaded_only_when_a_figure_is_drawn():
    code = "import sys, counterspin.reports.figure; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
