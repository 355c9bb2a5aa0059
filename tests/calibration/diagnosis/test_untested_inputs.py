"""Remarks name inputs that the data cannot test and the effect of their errors."""

import math
import re

import numpy as np
import pytest
from campaigns import PLACE, format_runs, replace_parts, write_and_read_campaign, write_description
from reading_descriptions import format_rest_run

from counterspin.calibration.calibrate import calibrate
from counterspin.simulation.simulate import simulate

TUMBLE = """
schema = 1
site = { gravity = "9.8 m/s^2", latitude = "45 deg" }

[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"

[model]
terms = ["K_F", "K_I", "delta_O"]
priors = { "head.harmonic" = "0 ± 0.2 arcsec" }

"""

#: The bias, the scale factor and K_5 (similar to K_III) are stated; the clock is not.
RECORDED = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 2e-6 g"
scale_factor = "1.002 ± 5e-6 g/g"
K_5 = "0 ± 1e-10 g/g^5"
velocity = {{ column = "east", unit = "m/s" }}

[noise]
velocity = "1e-3 m/s"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "20 Hz"
revolutions = 30

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2e-5 g/g^2"
"""


def untested_remarks(result):
    unchecked = "depends on values that the data cannot verify"
    return [text for text in result.warnings if unchecked in text]


def calibrate_tumble(folder, mountings=(0,), more=""):
    rng = np.random.default_rng(4)
    text = replace_parts(TUMBLE, ("priors = {", f"priors = {{ {more}"))
    for turn in mountings:
        for angle in range(0, 360, 15):
            value = 2e-3 + math.cos(math.radians(angle)) + 2e-6 * rng.standard_normal()
            text += format_rest_run(
                f"{turn} {angle}",
                f"{angle} deg about north",
                f"{value:.9f} ± 2e-6 g",
                f'head = "{(angle + turn) % 360} deg"\nmounting = "m{turn}"\n',
            )
    return calibrate(write_description(folder, text).parent)


@pytest.mark.parametrize(
    ("source", "symbol", "unit", "seen"),
    [("1.sin", "K_F", 1e-6, False), ("4.sin", "K_I", 1.0, True)],
)
def test_head_with_understated_error_has_remark(tmp_path, source, symbol, unit, seen):
    """A first harmonic of 2.06 arcsec shifts K_F by 10 ug and has no other effect.

    A fourth harmonic of this size is slightly visible: the remark states the undetected size.
    """
    result = calibrate_tumble(tmp_path / "stated")
    assert (result.state, result.findings) == ("good", [])
    (text,) = untested_remarks(result)
    match = re.search(
        rf"the stated value of head\.harmonic\.{re.escape(source)} has an error of ([\d.]+) "
        rf"arcsec, "
        rf"the error of {symbol} is ([\d.e-]+) \S+, or ([\d.]+) u\(",
        text,
    )
    assert match, text
    size, shift, times = (float(number) for number in match.groups())
    typical = math.degrees(1e-5) * 3600.0
    assert size < 0.9 * typical if seen else size == pytest.approx(typical, rel=0.03)
    erring = f'"head.harmonic.{source}" = "{size} ± 0.2 arcsec", '
    before, after = (
        one.accelerometers["A"].coefficients[symbol]
        for one in (result, calibrate_tumble(tmp_path / "erring", more=erring))
    )
    assert abs(after.value - before.value) == pytest.approx(shift * unit, rel=0.05)
    assert shift * unit / before.u == pytest.approx(times, rel=0.05)
    assert times > 2.5


@pytest.mark.parametrize("size", ["2.06 arcsec", "0.2 arcsec"])
def test_typical_or_tested_input_has_no_remark(tmp_path, size, monkeypatch):
    """Two mountings determine the error of the head, whatever its prior."""
    monkeypatch.setitem(globals(), "TUMBLE", replace_parts(TUMBLE, ("0.2 arcsec", size)))
    typical = size.startswith("2")
    assert untested_remarks(calibrate_tumble(tmp_path, (0,) if typical else (0, 60, 135))) == []


def test_untested_clock_of_single_run_has_remark(tmp_path):
    """An error of 20 ppm shifts K_III and does not appear in the residuals."""
    folder = tmp_path / "made"
    simulate(write_and_read_campaign(tmp_path / "true", RECORDED), folder)
    result = calibrate(folder)
    assert (result.state, result.findings) == ("good", [])
    (text,) = untested_remarks(result)
    run, shift = re.search(
        r"if the clock during (\w+) only has an error of 20 ppm, the error of K_III is ([\d.]+) ug",
        text,
    ).groups()
    record = folder / f"{run}.csv"
    head, *rows = record.read_text().splitlines()
    late = (row.split(",", 1) for row in rows)
    record.write_text(
        "\n".join([head, *(f"{float(time) * (1 + 2e-5):.12g},{rest}" for time, rest in late)])
    )
    off = calibrate(folder)
    assert off.state == "good"
    before, after = (one.accelerometers["Qx"].coefficients["K_III"] for one in (result, off))
    assert 1e6 * abs(after.value - before.value) == pytest.approx(float(shift), rel=0.1)
    # A second recorder has a separate clock, whose uncertainty is in u.
    text = (folder / "campaign.toml").read_text()
    line = f'record = "{run}.csv"'
    named = replace_parts(text, (line, f'{line}\nrecords = {{ recorder = "B" }}'))
    own = calibrate(write_description(folder, named).parent)
    assert f"clock during {run}" not in "".join(untested_remarks(own))
    assert own.accelerometers["Qx"].coefficients["K_III"].u > 1.5 * before.u
