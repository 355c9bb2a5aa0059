"""What a researcher does in a notebook: each task is a few lines of their own code.

The lines that count are the bodies of the functions `task_...`: at most five each, which a test
holds them to; what comes of them is checked in the tests.
"""

import ast
from pathlib import Path

import frames
import polars as pl
import pytest

import counterspin as cs


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return data frames by run."""
    new_columns = frames.simulate_columns(tmp_path_factory.mktemp("records"))
    return {name: pl.DataFrame(dict(columns)) for name, columns in new_columns.items()}


@pytest.fixture(scope="module")
def campaign(records):
    return cs.make_campaign(frames.parse_description_without_truth(), records)


@pytest.fixture(scope="module")
def result(campaign):
    return cs.calibrate(campaign)


def k_ii(result):
    return result.accelerometers["Qx"].coefficients["K_II"]


# --- the tasks ------------------------------------------------------------------------------------


def task_calibrate_frames(description, records):
    campaign = cs.make_campaign(description, records)
    return cs.calibrate(campaign).accelerometers["Qx"].coefficients["K_II"]


def task_compare_models(campaign):
    models = [["K_F", "K_I", "K_II"], ["K_F", "K_I", "K_II", "K_III"]]
    return cs.compare(
        *(cs.calibrate(campaign.change({"model": {"terms": terms}})) for terms in models)
    )


def task_own_residual_plot(result, axes):
    for (run,), rows in result.residuals("Qx").group_by("run", maintain_order=True):
        axes.plot(rows["time"], 1e3 * rows["residual"], ".", label=run)
    axes.set(xlabel="time, s", ylabel="residual, mm")


def task_labelled_covariance(result):
    covariance = result.covariance.frame().filter(pl.col("term").str.ends_with("K_II"))
    return covariance, result.correlation.frame().row(by_predicate=pl.col("term") == "Qx.K_II")


def task_pandas(result):
    return result.table("pandas").query("term == 'K_II'")


def task_simulate_another_truth(description):
    campaign = cs.make_campaign(description).change({"truth": {"Qx": {"K_II": "5e-5 g/g^2"}}})
    return cs.calibrate(cs.simulate(campaign))


def task_sweep(campaign):
    radii = [2.4995, 2.5, 2.5005]
    results = [
        cs.calibrate(campaign.change({"centrifuge": {"radius": f"{radius} m"}})) for radius in radii
    ]
    return [r.accelerometers["Qx"].coefficients["K_II"].value for r in results]


def task_two_stages(records, trajectories):
    runs = []
    for name, columns in records.items():
        strobes = cs.strobes_by_angle(*columns, cs.strobe_angle(cs.QX.input_axis))
        runs.append(cs.StrobedRun(name, trajectories[name], cs.first_stage(strobes, sigma=0.01)))
    return cs.second_stage(runs, cs.QX).estimate("K_II")


def task_one_accelerometer(campaign):
    return cs.calibrate(campaign.change({"accelerometers": {"Qy": None}}))


# --- what comes of them ---------------------------------------------------------------------------


def tasks():
    tree = ast.parse(Path(__file__).read_text(encoding="utf-8"))
    functions = (node for node in tree.body if isinstance(node, ast.FunctionDef))
    return [node for node in functions if node.name.startswith("task_")]


@pytest.mark.parametrize("task", tasks(), ids=lambda task: task.name)
def test_tasks_have_at_most_five_lines(task):
    assert task.end_lineno - task.lineno <= 5


def test_frames_are_calibrated(records):
    result = task_calibrate_frames(frames.parse_description_without_truth(), records)
    assert abs(result.value - 2.7e-5) < 4.0 * result.u


def test_models_are_compared(campaign):
    compared = task_compare_models(campaign)
    (k_ii,) = (c for c in compared.coefficients if (c.accelerometer, c.term) == ("Qx", "K_II"))
    # One term more: the difference is less certain than nothing and far less than the estimate.
    assert 0.0 < k_ii.estimates[1].u_difference < 0.1 * k_ii.estimates[0].u
    assert [a.dof for a in compared.agreements] == [1, 1]
    assert [c.subject for c in compared.changes] == [
        "terms of Qx",
        "terms of Qy",
        "terms fixed at nominal",  # every term that is not requested
        "campaign.toml",
    ]


def test_residuals_are_plotted_by_hand(result):
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    task_own_residual_plot(result, axes)
    assert [line.get_label() for line in axes.lines] == ["slow", "middle", "fast"]
    drawn = axes.lines[0].get_ydata()
    assert 5.0 < drawn.std() < 15.0  # mm; the noise is 10 mm


def test_covariance_has_labels(result):
    covariance, (_, *correlation) = task_labelled_covariance(result)
    own = covariance["Qx.K_II"][0]
    assert own == pytest.approx(k_ii(result).u ** 2, rel=1e-12)
    assert abs(covariance["Qy.K_II"][0]) < own
    assert max(correlation) == pytest.approx(1.0)


def test_result_frame_for_pandas(result):
    table = task_pandas(result)
    assert list(table["owner"]) == ["Qx", "Qy"]
    assert list(table["value"] * 1e-6) == pytest.approx(
        [result.accelerometers[name].coefficients["K_II"].value for name in ("Qx", "Qy")]
    )


def test_other_truth_is_estimated():
    k_ii_result = k_ii(task_simulate_another_truth(frames.parse_small_description()))
    assert abs(k_ii_result.value - 5e-5) < 4.0 * k_ii_result.u


def test_radius_sweep_changes_k_ii(campaign, result):
    low, middle, high = task_sweep(campaign)
    assert middle == k_ii(result).value
    # Reference and squared force are near to linear in a small change of the radius.
    assert abs(high - low) > 0.0
    assert abs(low - 2.0 * middle + high) < 0.01 * abs(high - low)


def test_two_stages_by_hand_estimate_truth(campaign, records):
    columns = {
        name: [frame[column].to_numpy() for column in ("time_s", "angle_rad", "east_m")]
        for name, frame in records.items()
    }
    trajectories = {
        run.name: cs.Trajectory(cs.Spindle(run.rate), campaign.radius.value, campaign.site)
        for run in campaign.runs
    }
    value, u = task_two_stages(columns, trajectories)
    assert abs(value - 2.7e-5) < 4.0 * u


def test_single_accelerometer_matches_joint_result(campaign, result):
    alone = task_one_accelerometer(campaign)
    assert list(alone.accelerometers) == ["Qx"]
    assert abs(k_ii(alone).value - k_ii(result).value) < k_ii(result).u
