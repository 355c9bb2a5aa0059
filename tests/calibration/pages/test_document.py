"""The full report: content and order."""

import math
import shlex

import pytest
from results import make_coefficient, make_qx_result, make_trace

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages import document as pages_document
from counterspin.calibration.pages.accelerometer import accelerometer_blocks
from counterspin.calibration.pages.pictures import (
    budget_bars,
    correlation_map,
    jackknife_plot,
    residual_plots,
    ripple_plot,
)
from counterspin.reports.blocks import (
    Bars,
    Heading,
    HeatMap,
    Paragraph,
    Picture,
    Plot,
    Table,
    expand_cards,
    remove_pictures,
)

#: Residuals eight times as large as the stated noise.
MISFIT = {"rms": 0.08, "unit": "m", "dof": 100.0, "chi2": 6400.0, "lack_of_fit_p": 0.0}


def build_document(result):
    """Return the blocks of the report with typeset text."""
    return list(expand_cards(pages_document.full_report_blocks(result)))


def block_texts(blocks):
    return [block.text for block in blocks if isinstance(block, Heading | Paragraph)]


def test_answer_is_first_in_both_units():
    first = build_document(make_qx_result())[:2]
    assert first[0] == Heading("By hand", 1)
    assert first[1].style == "answer"
    # Student's t for 50 degrees of freedom: 2.0086.
    assert first[1].text == (
        "K_II of Qx = 27.0000 ± 0.0010 µg/g² = (2.70000 ± 0.00010) × 10⁻⁵ g/g²"
        "   (95 %: 26.9980 to 27.0020 µg/g², 50 dof)"
    )


@pytest.mark.parametrize(("dof", "shown"), [(999.0, True), (1000.0, False), (9.7e8, False)])
def test_large_degrees_of_freedom_are_not_shown(dof, shown):
    calibration = make_qx_result()
    coefficients = calibration.accelerometers["Qx"].coefficients
    coefficients["K_II"] = coefficients["K_II"].model_copy(update={"dof": dof})
    assert (" dof)" in build_document(calibration)[1].text) is shown


def test_chapters_are_in_order():
    headings = [
        b.text for b in build_document(make_qx_result()) if isinstance(b, Heading) and b.level == 2
    ]
    assert headings == ["Coefficients", "Uncertainty budget", "Residuals", "Runs", "Inputs"]
    sections = [
        b.text for b in build_document(make_qx_result()) if isinstance(b, Heading) and b.level == 3
    ]
    wanted = ["Quality checks", "Accelerometer Qx", "Platform", "Residuals of Qx", "Model"]
    assert [h for h in sections if h in wanted] == wanted
    assert sections[-1] == "Inputs and reproducibility"


def quality_checks(blocks):
    """Return the verdict sentence of a result and the table below it."""
    place = blocks.index(Heading("Quality checks", 3))
    sentence, table = blocks[place + 1 : place + 3]
    assert isinstance(table, Table)
    assert [column.title for column in table.columns] == ["Check", "Outcome"]
    return sentence, table.rows


def test_good_result_lists_checks():
    sentence, rows = quality_checks(build_document(make_qx_result()))
    assert sentence == Paragraph("The result for Qx passed all checks.")
    assert rows == (
        ("Fit", "The residuals are consistent with the stated noise (p = 0.5)."),
        ("Leave-one-run-out", "No single run dominates the result."),
        ("Another method", "The two-stage result agrees with the joint result."),
    )


def test_warnings_appear_once_and_first():
    blocks = build_document(make_qx_result(warnings=["Qx: something is odd"]))
    sentence, rows = quality_checks(blocks)
    assert sentence == Paragraph(
        "The result for Qx is usable with reservations (1 finding).", "warning"
    )
    assert rows[0] == ("Warning", "something is odd")
    assert "something is odd" not in " ".join(block_texts(blocks))


def test_findings_appear_once_and_first():
    lost = {"code": "strobes-lost", "subject": "Qx", "text": "3 strobes were left out."}
    drives = [{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -4.0}]
    blocks = build_document(make_qx_result(findings=[lost], jackknife=drives))
    sentence, rows = quality_checks(blocks)
    assert sentence.style == "warning"
    assert sentence.text.endswith("reservations (2 findings, most serious first).")
    assert {row[0] for row in rows[:2]} == {"Strobes lost", "Run disagrees: K_II"}
    for words in ("3 strobes were", "Omitting slow shifts K_II"):
        assert sum(words in row[1] for row in rows) == 1


def test_contradicted_result_starts_with_warning_and_has_no_interval():
    blocks = build_document(make_qx_result(residual=MISFIT))
    assert blocks[0] == Heading("By hand", 1)
    assert blocks[1].style == "warning"
    assert blocks[1].text.startswith("The records contradict this result (Qx). The residuals are 8")
    assert blocks[2] == Paragraph(
        "K_II of Qx = 27.0000 ± 0.0010 µg/g² = (2.70000 ± 0.00010) × 10⁻⁵ g/g²"
    )
    assert not [b for b in blocks if getattr(b, "style", "") == "answer"]
    assert not [text for text in block_texts(blocks) if "95 %: " in text]


def test_style_of_answer_follows_state():
    drives = [{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -4.0}]
    for result, style in (
        (make_qx_result(), "answer"),
        (make_qx_result(jackknife=drives), "reserved"),
    ):
        (line,) = (
            b for b in build_document(result) if getattr(b, "text", "").startswith("K_II of Qx =")
        )
        assert line.style == style


def test_accepted_misfit_is_printed_with_reason_and_command():
    accepted = judge_result(make_qx_result(residual=MISFIT), "the arm's play is known")
    written = block_texts(build_document(accepted))
    assert "The misfit was accepted: the arm's play is known" in written[2]
    command = """counterspin calibrate . '--accept-misfit=the arm'"'"'s play is known'"""
    assert command in written


def test_full_result_has_all_plots():
    pictures = [b for b in build_document(make_qx_result()) if isinstance(b, Picture)]
    assert sum(isinstance(p, HeatMap) for p in pictures) == 1
    assert sum(isinstance(p, Bars) for p in pictures) == 1
    titles = [p.title for p in pictures if isinstance(p, Plot)]
    assert titles == [
        "K_II of Qx with each run omitted in turn",
        "Residuals of Qx, slow",
        "Residuals of Qx, fast",
        "Mean residual of Qx as a function of the spindle angle",
        "Spectrum of the whitened residuals of Qx",
        "Detrended normal Q-Q plot of whitened residuals of Qx",
        "Rate ripple by harmonic; error bars: 95 % intervals",
    ]


def test_result_without_series_has_no_plots():
    bare = make_qx_result(traces={}, budget={}, jackknife=[], correlation=None)
    for run in bare.runs.values():
        run.ripples.clear()
    assert not [b for b in build_document(bare) if isinstance(b, Picture)]


def test_model_equation_lists_used_terms():
    kept = make_qx_result().accelerometers["Qx"].coefficients
    more = kept | {
        "K_OQ": make_coefficient(0.0, 1e-9, "g/g^2"),
        "delta_P": make_coefficient(0.0, 1e-6, "rad"),
    }
    written = block_texts(build_document(make_qx_result(coefficients=more)))
    assert "Qx: a_ind = K_F + K_I a_I + K_II a_I² + K_OQ a_I |a_I| − delta_P a_O" in written
    assert any("platform.drift.north" in text for text in written)
    assert "counterspin calibrate ." in written


def test_command_of_two_stage_result_states_method():
    old = make_qx_result().model_copy(update={"method": "two-stage"})
    assert "counterspin calibrate . --method=two-stage" in block_texts(build_document(old))
    stated = old.provenance.model_copy(update={"options": ["--method=two-stage", "--sigma=given"]})
    written = block_texts(build_document(old.model_copy(update={"provenance": stated})))
    assert "counterspin calibrate . --method=two-stage --sigma=given" in written


def test_command_is_quoted_for_shell():
    options = ["--method=two-stage", "--sigma=a b; rm -r ~ $(x) `y` 'z'"]
    qx_result = make_qx_result()
    qx_result = qx_result.model_copy(
        update={"provenance": qx_result.provenance.model_copy(update={"options": options})}
    )
    (command,) = (b.text for b in build_document(qx_result) if getattr(b, "style", "") == "command")
    assert shlex.split(command) == ["counterspin", "calibrate", ".", *options]


def test_degrees_of_freedom_are_integers_and_units_are_typeset():
    residual = {"rms": 0.01, "unit": "m", "dof": 21659.98}
    written = " ".join(block_texts(build_document(make_qx_result(residual=residual))))
    assert "21660 degrees of freedom" in written
    assert "Gravity 9.8 m/s², latitude" in written


def test_text_without_plots_has_no_empty_chapters():
    picture = next(
        residual_plots("Qx", make_qx_result().accelerometers["Qx"], make_qx_result().runs)
    )
    heading, two, deep, paragraph = Heading("1"), Heading("2"), Heading("3", 3), Paragraph("words")
    assert remove_pictures([heading, deep, picture, two, paragraph]) == [two, paragraph]
    assert remove_pictures([heading, picture, deep, paragraph, two, picture]) == [
        heading,
        deep,
        paragraph,
    ]
    assert remove_pictures([heading, paragraph, picture, picture, two]) == [heading, paragraph, two]


def test_identifier_depends_on_result():
    assert make_qx_result().identifier == make_qx_result().identifier
    assert make_qx_result().identifier != make_qx_result(serial_number="Q-105").identifier


# Plots


def test_residual_plot_keeps_outliers_and_uses_millimetres():
    first = next(residual_plots("Qx", make_qx_result().accelerometers["Qx"], make_qx_result().runs))
    assert first.zoom
    band, outliers = first.series
    assert band.low == (-10.0, -20.0, -15.0)
    assert band.high == (10.0, 30.0, 20.0)
    assert outliers.is_highlighted
    assert (outliers.x, outliers.y) == ((1.2,), (400.0,))
    assert first.y_label == "residual, mm"


def test_many_runs_are_divided_among_plots():
    traces = {f"run{i}": make_trace() for i in range(8)}
    plots = list(residual_plots("Qx", make_qx_result(traces=traces).accelerometers["Qx"], {}))
    assert len(plots) == 8 + 2 * 3
    labels = [s.label for p in plots if "of the spindle angle" in p.title for s in p.series]
    assert labels == list(traces)


def test_angle_without_samples_is_gap():
    fold = list(residual_plots("Qx", make_qx_result().accelerometers["Qx"], make_qx_result().runs))[
        2
    ]
    assert fold.series[0].x == (90.0, 270.0)
    assert fold.series[0].y == (1.0, None)


def test_run_has_same_colour_in_all_plots():
    calibration = make_qx_result(
        traces={"fast": make_trace(rows=3, rms=0.01), "slow": make_trace(rows=900, rms=0.02)}
    )
    colours = {"fast": set(), "slow": set()}
    pictures = [*residual_plots("Qx", calibration.accelerometers["Qx"], calibration.runs)]
    for plot in [*pictures, ripple_plot(calibration.runs)]:
        for series in plot.series:
            run = series.label or plot.title.rpartition(", ")[2]
            run = plot.title.rpartition(", ")[2] if run.startswith("samples") else run
            if run in colours and series.colour != "muted":
                colours[run].add(series.colour)
    assert colours == {"slow": {0}, "fast": {1}}


def test_residual_plot_has_labels_and_rms_limits():
    calibration = make_qx_result(traces={"slow": make_trace(rows=3, rms=0.01)})
    calibration.runs["slow"].counts["block"] = 7
    first = next(residual_plots("Qx", calibration.accelerometers["Qx"], calibration.runs))
    band, upper, lower, _ = first.series
    assert band.label == "means of 7 samples, from smallest to largest"
    assert (upper.label, upper.y, lower.y) == ("± 2 rms", (20.0, 20.0), (-20.0, -20.0))


def test_spectrum_has_white_noise_band():
    spectrum = {"frequency": [0.1, 1.0], "power": [0.9, 1.1], "lines": [1, 100]}
    calibration = make_qx_result(traces={"slow": make_trace(spectrum=spectrum)})
    plots = list(residual_plots("Qx", calibration.accelerometers["Qx"], calibration.runs))
    (plot,) = (plot for plot in plots if plot.title.startswith("Spectrum"))
    band, _ = plot.series
    # One line is exponential; a mean of 100 lines is nearly normal with standard deviation 0.1.
    assert band.low[0] == pytest.approx(-math.log(0.975), rel=1e-12)
    assert band.high[0] == pytest.approx(-math.log(0.025), rel=1e-12)
    assert (band.low[1], band.high[1]) == pytest.approx((0.8136, 1.2053), abs=2e-4)


def test_quantile_plot_shows_difference_from_normal_with_band():
    calibration = make_qx_result(traces={"slow": make_trace(rows=400)})
    *_, plot = residual_plots("Qx", calibration.accelerometers["Qx"], calibration.runs)
    band, series = plot.series
    assert series.y == pytest.approx((0.2, 0.1, 0.3))
    # The median of n normal samples has the standard deviation sqrt(pi/2/n).
    assert band.high[1] == pytest.approx(1.96 * math.sqrt(math.pi / 2 / 400), rel=1e-12)
    assert band.low == pytest.approx([-height for height in band.high])


def test_jackknife_plot_shows_uncertainty_of_shift():
    plot = jackknife_plot("Qx", make_qx_result().accelerometers["Qx"])
    band, points = plot.series
    assert band.low == pytest.approx((26.999, 26.999))
    assert points.y == pytest.approx((27.001,))
    # shift 1e-9 at z = 0.5: its standard uncertainty is 2e-9, or 0.002 ug/g^2.
    assert points.high == pytest.approx((27.003,))
    assert plot.x_names == ("slow",)


def test_budget_and_correlation_plots():
    accelerometer = make_qx_result().accelerometers["Qx"]
    bars = budget_bars("Qx", accelerometer)
    assert bars.stacked
    assert bars.values == pytest.approx((64.0, 36.0))
    assert bars.labels == ("noise of Qx (Type B)", "scale factor, K_I (Type B)")
    assert bars.colours[0] != bars.colours[1]
    assert bars.texts == ("0.00080 (64 %)", "0.00060 (36 %)")
    assert correlation_map("Qx", accelerometer).values == ((1.0, 0.25), (0.25, 1.0))


@pytest.mark.parametrize(
    ("correlation", "rows"),
    [
        (0.8999, []),
        (-0.93, [("bias, K_F", "second-order coefficient, K_II", "-0.9300")]),
        (1.0 - 1e-7, [("bias, K_F", "second-order coefficient, K_II", "1 - 1e-7")]),
    ],
)
def test_strongly_correlated_estimates_are_listed(correlation, rows):
    matrix = [[1.0, correlation], [correlation, 1.0]]
    kept = make_qx_result(correlation={"terms": ["K_F", "K_II"], "matrix": matrix})
    blocks = list(accelerometer_blocks("Qx", kept.accelerometers["Qx"], 9.8, show_details=True))
    text = [block for block in blocks if isinstance(block, Paragraph)][-1].text
    tables = [block for block in blocks if isinstance(block, Table)]
    assert text == (
        "Correlations with magnitude above 0.9:"
        if rows
        else "No correlation between two estimates exceeds 0.9 in magnitude."
    )
    actual_rows = [table.rows for table in tables if table.columns[0].title == "Estimate"]
    assert actual_rows == ([tuple(rows)] if rows else [])


def test_ripple_is_relative_to_magnitude_of_rate():
    (series,) = ripple_plot(make_qx_result().runs).series
    assert series.label == "slow"
    assert series.y == pytest.approx((1.0,))
    assert series.low == pytest.approx((1.0 - 0.196,))
