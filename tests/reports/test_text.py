"""The text report: rounding, layout at 80 columns and missing values."""

import io
import math
import re
import subprocess
import sys

import pytest
from results import make_accelerometer_result, make_bare_result, make_run
from rich.console import Console

from counterspin.calibration.pages.document import print_result, render, result_blocks
from counterspin.calibration.result_parts import (
    Coefficient,
    Comparison,
    Correlation,
    NoiseLine,
    ParabolaResult,
    Residual,
    RippleResult,
)
from counterspin.characters import MultilineText
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.summary import BudgetLine, Jackknife
from counterspin.physics.terms import PLATFORM_TERMS, TERMS
from counterspin.reports.blocks import Column, Heading, Paragraph, Table
from counterspin.reports.numbers import NOT_DETERMINED
from counterspin.reports.text import Report, make_console

ARCSEC = math.pi / 648000.0
DEG_H = math.pi / 180.0 / 3600.0

K_II = Coefficient(
    value=2.70445e-5,
    u=7.0e-10,
    u_noise=6.0e-10,
    u_stated=3.0e-10,
    u_unstated=2.0e-10,
    dof=20.0,
    unit="g/g^2",
    estimated=True,
)
K_F = Coefficient(value=0.0050321, u=2e-6, u_noise=2e-6, unit="g", estimated=True)
K_I = Coefficient(value=1.0019743, u=5e-6, unit="g/g", estimated=False)
K_III = Coefficient(value=None, u=None, unit="g/g^3", estimated=False)


def make_all_coefficients():
    """Return all coefficients with long values."""
    return {
        symbol: Coefficient(
            value=-1.23456789e-5, u=2.3e-11, u_noise=2.3e-11, unit=row.unit, estimated=True
        )
        for symbol, row in TERMS.items()
    }


def make_accelerometer(**changes):
    parts = {
        "coefficients": {"K_F": K_F, "K_I": K_I, "K_II": K_II, "K_III": K_III},
        "correlation": Correlation(
            terms=["K_F", "K_II"],
            matrix=[[1.0, -0.9612], [-0.9612, 1.0]],
        ),
        "residual": Residual(rms=0.0099812, unit="m", dof=35000.0),
    }
    return make_accelerometer_result(**(parts | changes))


def make_result(**changes):
    parts = {
        "title": "Three-rate campaign",
        "accelerometers": {"Qx": make_accelerometer()},
        "inputs": {"gravity": 9.8066, "latitude": math.radians(45.75), "radius": 2.5},
    }
    return make_bare_result(**(parts | changes))


def make_full_result():
    """Return a result with all parts."""
    accelerometer = make_accelerometer(
        coefficients=make_all_coefficients() | {"K_II": K_II, "K_III": K_III},
        confounded=[
            ConfoundedTerms(
                terms=["K_I", "K_IP"],
                correlation=1.0 - 6e-11,
                determined="K_I - K_IP",
                value=1.0019743,
                u=1.2e-7,
            ),
            ConfoundedTerms(
                terms=["K_F", "K_PP", "delta_O"], correlation=-0.98, determined="K_F + K_PP"
            ),
        ],
        residual=Residual(rms=0.0099812, unit="m", dof=35000.0, chi2=34650.0, lack_of_fit_p=0.4123),
        noise={
            "displacement": NoiseLine(value=0.0100213, u=3.81e-5, unit="m", estimated=True),
            "acceleration": NoiseLine(value=2.94e-5, unit="m/s^2/Hz^0.5", estimated=False),
        },
        budget={
            "K_II": [
                BudgetLine(
                    source="noise of the records",
                    kind="noise",
                    u=None,
                    unit="",
                    sensitivity=None,
                    contribution=6.0e-10,
                    share=36 / 45,
                ),
                BudgetLine(
                    source="platform.tilt.north (run1)",
                    kind="stated",
                    u=0.5 * ARCSEC,
                    unit="rad",
                    sensitivity=3e-10 / (0.5 * ARCSEC),
                    contribution=3.0e-10,
                    share=9 / 45,
                ),
            ]
        },
        second_unknown={
            "spindle.drift": Coefficient(value=1e-9, u=2e-10, unit="1/s", estimated=True)
        },
        jackknife=[
            Jackknife(run="run1", value=2.70446e-5, shift=1e-10, z=0.31),
            Jackknife(run="run2", value=None, shift=None, z=None),
        ],
        two_stage=Comparison(
            value=2.7041e-5, u=5.3e-9, difference=-3.5e-9, u_difference=5.2e-9, z=-0.673
        ),
        warnings=["Qx: The runs do not agree with the model ± anything."],
    )
    tilt = Coefficient(value=0.21 * ARCSEC, u=0.05 * ARCSEC, unit="rad", estimated=True)
    turning = make_run(
        rate=math.pi / 2,
        samples=20101,
        u_rate=2.4e-10,
        drift=-1e-12,
        u_drift=7.5e-13,
        ripples=[
            RippleResult(harmonic=1, amplitude=7.9e-7, u_amplitude=1.6e-8, phase=0.1, u_phase=0.02),
            RippleResult(harmonic=3, amplitude=1e-8, u_amplitude=1.6e-8, phase=0.1, u_phase=None),
        ],
        angle_rms=1e-6,
        rejected=12,
        counts={"rows": 20113, "outliers": 12},
        notes=["12 outliers in column 'east_m' were left out."],
        terms={"platform.tilt.north": tilt},
        parabolas={
            "Qx": ParabolaResult(
                b0=0.01, b1=0.02, b2=0.024683966, u_b2=3.8e-8, sigma=0.01,
                sigma_from_residuals=False, strobes=101,
            )
        },
        fit={"Qx": {"chi2_per_dof": 1.0213, "lack_of_fit_p": None, "spectrum": "white"}},
    )  # fmt: skip
    return make_result(
        accelerometers={"Qx": accelerometer, "Qy": make_accelerometer()},
        platform={
            "platform.drift.north": Coefficient(
                value=0.01 * DEG_H, u=0.002 * DEG_H, unit="rad/s", estimated=True
            )
        },
        runs={"run1": turning, "run2": make_run(rate=-math.pi)},
        details={"laboratory": "Centrifuge hall", "serial_number": "17"},
        warnings=["run2: the spindle turned at another rate."],
    )


def render_text(result, width=160, **options):
    stream = io.StringIO()
    print_result(result, Console(file=stream, width=width, highlight=False), **options)
    return stream.getvalue()


def find_line(text, *words):
    """Return the only line that contains all the words."""
    lines = [line for line in text.splitlines() if all(word in line for word in words)]
    assert len(lines) == 1, f"{words} is in {len(lines)} lines of\n{text}"
    return lines[0]


def collapse_spaces(text):
    return " ".join(text.split())


# The answer


def test_answer_is_first_with_student_interval():
    lines = render_text(make_result()).splitlines()
    assert lines[0] == "Three-rate campaign"
    # t(0.975, 20) = 2.0860 (GUM table G.2: 2.09), times 0.00070
    assert lines[1] == (
        "K_II of Qx = 27.04450 ± 0.00070 ug/g^2   (95 %: 27.04304 to 27.04596, 20 dof)"
    )


def test_infinite_degrees_of_freedom_give_normal_interval():
    normal = K_II.model_copy(update={"dof": None})
    result = make_result(accelerometers={"Qx": make_accelerometer(coefficients={"K_II": normal})})
    assert "(95 %: 27.04313 to 27.04587)" in render_text(result)


def test_gravity_and_meaning_of_uncertainty_are_stated():
    text = collapse_spaces(render_text(make_result()))
    assert (
        "Joint method, exact model. The number after ± is the standard uncertainty (k = 1)." in text
    )
    assert "the local gravity, g = 9.8066 m/s^2" in text
    assert "K2 = K_II/K_I" in text


@pytest.mark.parametrize("prior", [None, 3.21e-6])
def test_undetermined_answer_has_no_value(prior):
    u = None if prior is None else 2e-6
    unknown = Coefficient(value=prior, u=u, unit="g/g^2", estimated=False)
    result = make_result(accelerometers={"Qx": make_accelerometer(coefficients={"K_II": unknown})})
    answer = find_line(render_text(result), "K_II of Qx")
    assert answer.startswith("K_II of Qx: not determined by these records")
    assert ("prior: 3.2 ± 2.0 ug/g^2" in answer) == (prior is not None)
    assert "95 %" not in answer


def test_report_of_campaign_without_k_ii():
    result = make_result(accelerometers={"Qx": make_accelerometer(coefficients={"K_F": K_F})})
    assert "K_II of" not in render_text(result)


# Coefficients


def test_coefficients_are_rounded_and_state_origin_of_uncertainty():
    text = render_text(make_result())
    assert collapse_spaces(find_line(text, "second-order")) == (
        "K_II second-order coefficient 27.04450 ± 0.00070 ug/g^2 "
        "noise 73 %, stated priors 18 %, default priors 8.2 %"
    )
    assert collapse_spaces(find_line(text, "bias")) == "K_F bias 5032.1 ± 2.0 ug noise 100 %"
    assert collapse_spaces(find_line(text, "scale factor")) == (
        "K_I scale factor 1.0019743 ± 0.0000050 g/g prior only"
    )


def test_undetermined_coefficient_shows_no_value():
    line = collapse_spaces(find_line(render_text(make_result()), "third-order"))
    assert line == f"K_III third-order coefficient - ug/g^3 {NOT_DETERMINED}"


def test_platform_terms_are_in_field_units():
    text = render_text(make_full_result())
    assert collapse_spaces(find_line(text, "gyro drift about north")).startswith(
        "gyro drift about north 0.0100 ± 0.0020 deg/h"
    )
    assert collapse_spaces(find_line(text, "tilt about north (run1)")).startswith(
        "tilt about north (run1) 0.210 ± 0.050 arcsec"
    )


def test_second_unknown_of_two_stage_method_is_named():
    line = collapse_spaces(find_line(render_text(make_full_result()), "rate drift"))
    assert line.startswith("C rate drift common to all runs 3.60 ± 0.72 ppm/h")


def test_all_terms_are_named_in_words():
    terms = {
        symbol: Coefficient(value=1e-9, u=1e-9, unit=row.unit, estimated=True)
        for symbol, row in PLATFORM_TERMS.items()
    }
    text = render_text(make_full_result().model_copy(update={"platform": terms}), 200)
    for row in (*TERMS.values(), *PLATFORM_TERMS.values()):
        assert row.words in text


# Confounded sets, fit and checks


def test_confounded_sets_are_described():
    text = collapse_spaces(render_text(make_full_result()))
    assert (
        "K_I and K_IP cannot be separated with these records (correlation 1 - 6e-11); "
        "the records determine only K_I - K_IP = 1.00197430 ± 0.00000012 g/g." in text
    )
    assert (
        "K_F, K_PP and delta_O can hardly be separated with these records (correlation -0.9800); "
        "the records determine only K_F + K_PP." in text
    )


def test_fit_noise_and_checks_are_reported():
    text = collapse_spaces(render_text(make_full_result()))
    assert (
        "Residuals: rms 0.00998 m, 35000 degrees of freedom; chi-square/dof 0.99; p = 0.41." in text
    )
    # 2.94e-5 m/s^2 is 2.998 ug where g is 9.8066 m/s^2.
    assert (
        "Noise: displacement 0.010021 ± 0.000038 m (estimated from the residuals); "
        "acceleration 2.99798 ug/Hz^0.5 (as given)." in text
    )
    assert (
        "Two-stage method: K_II = 27.0410 ± 0.0053 ug/g^2. Difference from the joint method: "
        "-0.0035 ± 0.0052 ug/g^2 (z = -0.673); consistent." in text
    )


def test_disagreement_with_two_stage_method_is_reported():
    apart = Comparison(value=2.8e-5, u=5e-9, difference=1e-6, u_difference=5e-9, z=200.0)
    result = make_result(accelerometers={"Qx": make_accelerometer(two_stage=apart)})
    assert "(z = 200); not consistent." in collapse_spaces(render_text(result))


def test_jackknife_is_rounded_like_estimate():
    rows = render_text(make_full_result()).partition("Omitted run")[2].splitlines()
    assert rows[2].split() == ["run1", "27.04460", "0.00010", "0.31"]
    assert rows[3].split() == ["run2", *NOT_DETERMINED.split() * 2, "-"]


def test_verdict_and_warnings_follow_answer_in_yellow():
    text = collapse_spaces(render_text(make_full_result()))
    first = text.index("Warning: run2: the spindle turned at another rate.")
    verdict = text.index("The result for Qx is usable with reservations: ")
    finding = text.index("The runs do not agree with the model ± anything.")
    assert text.index("K_II of Qx") < first < verdict < finding < text.index("Accelerometer Qx")
    assert text.count("The runs do not agree with the model ± anything.") == 1
    stream = io.StringIO()
    print_result(
        make_full_result(),
        Console(file=stream, force_terminal=True, color_system="standard", width=100),
    )
    assert "\x1b[33mWarning: run2" in stream.getvalue()
    assert "\x1b[33mThe result for Qx is usable" in stream.getvalue()
    assert "\x1b[1;33mK_II of Qx" in stream.getvalue()


def test_budget_is_printed_on_request():
    assert "Uncertainty budget" not in render_text(make_full_result())
    rows = render_text(make_full_result(), budget=True).partition("Uncertainty budget of K_II, Qx")[
        2
    ]
    assert collapse_spaces(
        find_line(rows.partition("Accelerometer Qy")[0], "noise of the records")
    ) == ("noise of the records A 0.00060 80 %")
    assert collapse_spaces(find_line(rows, "0.5 arcsec")) == (
        "platform.tilt.north (run1) B 0.5 arcsec 0.0006 0.00030 20 %"
    )
    # sqrt(6^2 + 3^2) = 6.7
    assert collapse_spaces(find_line(rows, "combined")) == "combined 0.00067"


def test_details_are_printed_on_request():
    assert "sha256" not in render_text(make_full_result())
    text = collapse_spaces(render_text(make_full_result(), details=True))
    assert "campaign.toml sha256:" + "0f" * 32 in text
    assert "bias, K_F second-order coefficient, K_II -0.9612" in text
    assert "run1: 20113 rows, 12 outliers." in text
    assert "0.206 arcsec rms" in text
    assert "Radius 2.5 m, latitude 45.75 deg." in text


def test_campaign_details_are_printed():
    assert "Laboratory Centrifuge hall; serial number 17." in render_text(make_full_result())


# Runs


def test_run_table_has_rate_ripple_and_rejected_samples():
    text = render_text(make_full_result())
    row = collapse_spaces(find_line(text, "1.57079632679(24)"))
    # -1e-12 and 7.5e-13 1/s are -0.0036 and 0.0027 ppm/h; 7.9e-7 of pi/2 rad/s is 0.503 ppm
    assert row == "run1 1.57079632679(24) -0.0036(27) 1: 0.503(10) 20101 12"
    assert collapse_spaces(find_line(text, "3: 0.006(10)")) == "3: 0.006(10)"
    assert collapse_spaces(find_line(text, "-3.14159 ")) == "run2 -3.14159 0 - 1000 0"
    assert "run1: 12 outliers in column 'east_m' were left out." in text


def test_first_stage_and_fit_of_runs_are_printed():
    text = render_text(make_full_result())
    assert (
        collapse_spaces(find_line(text, "0.024683966(38)"))
        == "run1 Qx 101 0.024683966(38) 0.01 given"
    )
    assert collapse_spaces(find_line(text, "white")) == "run1 Qx 1.021 - white"
    assert "chi2 per dof" in text


# Layout


@pytest.mark.parametrize("width", [80, 100])
def test_text_is_not_cut_at_usual_widths(width):
    result = make_full_result()
    text = render_text(result, width, budget=True, details=True)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    tokens = set(text.split())
    numbers = 0
    for block in result_blocks(result, show_budget=True, show_details=True):
        for row in getattr(block, "rows", ()):
            for column, cell in zip(block.columns, row, strict=True):
                if not column.wraps:
                    numbers += 1
                    assert tokens.issuperset(cell.split()), cell
    assert numbers > 80


@pytest.mark.parametrize("width", [30, 44, 60])
def test_narrow_terminal_loses_no_text(width):
    result = make_full_result()
    text = render_text(result, width, budget=True, details=True)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    for block in result_blocks(result, show_budget=True, show_details=True):
        if not hasattr(block, "rows"):
            assert "".join(block.text.split()) in "".join(text.split())
    wide = render_text(result, 200, budget=True, details=True)
    # Wrapping keeps all characters of the wide layout; names are repeated
    # where a table's columns have no room side by side.
    for character in "0123456789±":
        assert text.count(character) >= wide.count(character)
    if width > 30:
        number = re.compile(r"[-<]?\d[\d.]*(?:\(\d+\))?%?(?!\S)")
        assert set(number.findall(wide)) <= set(number.findall(text))


def test_plain_output_has_no_escape_codes_or_markup():
    result = make_result(title="[bold]Batch[/bold] [3]", runs={"[red]": make_run()})
    stream = io.StringIO()
    print_result(result, make_console(stream), budget=True, details=True)
    assert "\x1b" not in stream.getvalue()
    assert stream.getvalue().startswith("[bold]Batch[/bold] [3]\n")
    assert "[red]" in stream.getvalue()


def test_piped_output_has_100_columns(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert make_console(io.StringIO()).width == 100
    monkeypatch.setenv("COLUMNS", "72")
    assert make_console(io.StringIO()).width == 72


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_characters_are_replaced_for_limited_encoding(encoding):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding)
    print_result(make_full_result(), make_console(stream), budget=True, details=True)
    stream.flush()
    text = collapse_spaces(raw.getvalue().decode(encoding))
    sign = "±" if encoding == "latin-1" else "+/-"
    assert f"K_II of Qx = 27.04450 {sign} 0.00070 ug/g^2" in text
    assert f"the model {sign} anything" in text
    assert "?" not in text


def test_numbers_are_not_nan_or_python_repr():
    text = render_text(make_full_result(), budget=True, details=True)
    assert not re.search(r"\bnan\b|\bNone\b|\binf\b|e-0\d|np\.", text)


def test_render_equals_print_result():
    stream = io.StringIO()
    Console(file=stream, width=160, highlight=False).print(
        render(make_full_result(), show_budget=True)
    )
    assert stream.getvalue() == render_text(make_full_result(), budget=True)


def test_matplotlib_is_not_imported():
    code = "import sys, counterspin.reports.text; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_control_characters_are_escaped():
    stream = io.StringIO()
    blocks = [
        Heading("red\x1b[31m"),
        Paragraph("title\x9b31m\nK_II = 1"),
        Table((Column("a\u202e\nb"), Column("e")), (("c\x00\nd", MultilineText("f\x00\ng", "h")),)),
    ]
    make_console(stream).print(Report(blocks))
    lines = [line.rstrip() for line in stream.getvalue().splitlines()]
    assert lines[:2] == [r"red\x1b[31m", r"title\x9b31m\nK_II = 1"]
    # A cell may have several lines in its column; a name has one line.
    title, _, *cells = (line.split() for line in lines[3:])
    assert title == [r"a\u202e\nb", "e"]
    assert cells == [[r"c\x00\nd", r"f\x00\ng"], ["h"]]


def test_terminal_output_is_typeset():
    for terminal, shown in ((True, "2 × 10⁻⁵ µg/g²"), (False, "2e-5 ug/g^2")):
        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, color_system=None, width=80)
        console.print(Report([Paragraph("2e-5 ug/g^2"), Table((Column("ug"),), (("1",),))]))
        assert stream.getvalue().startswith(f"{shown}\n")
        assert ("µg" in stream.getvalue()) is terminal


def test_columns_that_do_not_fit_move_to_second_table():
    names = ("Qx.K_II", "platform.g_sensitivity.zx")
    columns = (Column("Coefficient"), *(Column(f"Share {n}", "right") for n in range(6)))
    rows = tuple((name, *(f"{n}.00074{n} ± 0.0000{n}1" for n in range(6))) for name in names)
    stream = io.StringIO()
    Console(file=stream, width=80, highlight=False).print(Report([Table(columns, rows)]))
    text = stream.getvalue()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert [text.count(name) for name in names] == [3, 3]
    for n in range(6):
        assert text.count(f"Share {n}") == 1
        assert text.count(f"{n}.00074{n} ± 0.0000{n}1") == 2


def test_column_titles_are_wrapped_before_table_is_split():
    table = Table((Column("Run"), Column("probability of more")), (("run1", "0.0123456"),))
    stream = io.StringIO()
    Console(file=stream, width=18, highlight=False).print(Report([table]))
    first, *more = stream.getvalue().splitlines()
    assert first.split() == ["probability"]
    assert more[0].split() == ["Run", "of", "more"]
    assert more[-1].split() == ["run1", "0.0123456"]


def test_terminal_shows_first_200_rows_of_table():
    rows = tuple((f"run {k}",) for k in range(203))
    stream = io.StringIO()
    make_console(stream).print(Report([Table((Column("name"),), rows)]))
    text = stream.getvalue()
    assert "run 199" in text
    assert "run 200" not in text
    assert "3 of 203 rows are not shown" in text
    shown = Table((Column("name"),), rows[:200], n_omitted=7).without_empty_columns()
    make_console(stream).print(Report([shown]))
    assert "7 of 207 rows are not shown" in stream.getvalue()
