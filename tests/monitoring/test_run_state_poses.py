"""Records of poses in progress: their state so far and the missing directions."""

from dataclasses import replace

import numpy as np
import posed_records
import pytest
from raising import raises

import counterspin as cs
import triads
from counterspin.cli import main
from counterspin.errors import CampaignError

FEW, MANY = (
    posed_records.simulate_poses(3.0, 1.5, 5),
    posed_records.simulate_poses(3.0, 1.5, 24, seed=2),
)


def make_rests(along):
    """Return a noiseless record with rests in directions, shape (n, 3)."""
    record = posed_records.simulate_poses(3.0, 1.5, len(along), noise=0.0)
    values = record.values.copy()
    noise = 0.01 * np.random.default_rng(3).standard_normal(values.shape)
    for start, end, own in zip(record.start, record.end, along, strict=True):
        values[(record.time >= start - 1e-6) & (record.time <= end + 1e-6)] = 9.81 * own
    return replace(record, values=values + noise, force=9.81 * along)


def compute_leverage(along, of):
    """Return u^2 of |f| relative to one pose, for nine unknowns, by the normal equations."""

    def design_rows(d):
        x, y, z = d.T
        return np.column_stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])

    gram = design_rows(along).T @ design_rows(along)
    return np.einsum("np,pq,nq->n", design_rows(of), np.linalg.inv(gram), design_rows(of))


def describe_direction(direction):
    signs = zip(direction, "XYZ", strict=True)
    return " ".join(f"{'-' if s < 0 else '+'}{name}" for s, name in signs if abs(s) > 0.1) + " up"


GRID = np.array([[x, y, z] for x in (1, -1, 0) for y in (1, -1, 0) for z in (1, -1, 0)][:-1])
UNIT = GRID / np.linalg.norm(GRID, axis=1)[:, None]


def test_good_record_of_poses_has_no_remark(tmp_path):
    posed_records.write_campaign(tmp_path, {"all": MANY})
    checked = cs.check(tmp_path / "all.log", tmp_path)
    result = cs.calibrate(tmp_path)
    assert (checked.good, checked.run.state, checked.why_not) == (True, "read", None)
    assert (checked.run.poses.count, checked.run.poses.outlying) == (24, [])
    assert (checked.run.rows, checked.run.sampling_rate) == (len(MANY.time), pytest.approx(100.0))
    assert checked.run.poses.threshold == result.triad.records["all"].threshold
    assert checked.run.poses.rms == pytest.approx(result.triad.rms_after, rel=1e-3)
    assert len(checked.reached) == 9
    for goal in checked.reached:
        own = result.coefficient(goal.name)
        assert (goal.value, goal.u) == (own.value, own.u)


@pytest.mark.parametrize("lowest", [0.25, -0.3])
def test_missing_directions_have_largest_uncertainty_of_force(tmp_path, lowest):
    along = triads.draw_directions(400, np.random.default_rng(5))
    along = along[along[:, 2] > lowest][:16]
    posed_records.write_campaign(tmp_path, {"all": make_rests(along)})
    missing = cs.check(tmp_path / "all.log", tmp_path).run.poses.missing
    expected = []
    while (size := compute_leverage(along, UNIT)).max() > 1.0:
        most = UNIT[np.argmax(size)]
        expected.append(describe_direction(most))
        along = np.vstack([along, most])
    assert missing == expected
    assert any("-Z" in entry for entry in missing)


def test_full_set_of_poses_has_no_missing_direction(tmp_path):
    along = UNIT[np.sum(np.abs(GRID), axis=1) < 3]
    posed_records.write_campaign(tmp_path, {"all": make_rests(along)})
    assert compute_leverage(along, UNIT).max() < 1.0
    assert cs.check(tmp_path / "all.log", tmp_path).run.poses.missing == []


def test_outlying_pose_is_named(tmp_path):
    record = replace(MANY, values=MANY.values.copy())
    rows = (record.time >= record.start[7] - 1e-6) & (record.time <= record.end[7] + 1e-6)
    record.values[rows] *= 1.01
    posed_records.write_campaign(tmp_path, {"all": record})
    checked = cs.check(tmp_path / "all.log", tmp_path)
    (name,) = checked.run.poses.outlying
    assert float(name.split()[1]) == pytest.approx(record.start[7], abs=1.0)
    assert any(f'The pose "{name}" deviates from the model' in text for text in checked.remarks)
    (state,) = cs.watch(tmp_path, once=True)
    assert name in str(state)


def test_too_few_poses_list_missing_directions_and_remain_usable(tmp_path):
    posed_records.write_campaign(tmp_path, {"few": FEW, "many": None})
    checked = cs.check(tmp_path / "few.log", tmp_path)
    assert not checked.good
    assert "cannot determine both" in checked.remarks[0]
    assert (checked.run.state, checked.run.poses.count) == ("read", 5)
    assert checked.run.poses.rms is None
    assert len(checked.run.poses.missing) >= 4  # at most five of nine unknowns are determined
    assert {found.u for found in checked.reached} == {None}
    (tmp_path / "many.log").write_text(posed_records.make_log(MANY), "utf-8")
    checked = cs.check(tmp_path / "few.log", tmp_path)
    result = cs.calibrate(tmp_path)
    assert (checked.good, checked.others) == (True, ["many"])
    assert checked.reached[0].u == result.coefficient(checked.reached[0].name).u


def test_record_shorter_than_rest_fails(tmp_path, capsys):
    short = replace(MANY, values=MANY.values[:100])
    posed_records.write_campaign(tmp_path, {"all": short})
    checked = cs.check(tmp_path / "all.log", tmp_path, run="all")
    assert (checked.good, checked.run.state, checked.run.poses) == (False, "failed", None)
    assert "all.log: the record lasts 0.99 s, which is less than one rest" in checked.run.why
    assert main(["check", str(tmp_path / "all.log"), "--campaign", str(tmp_path)]) == 1
    assert "failed its checks" in capsys.readouterr().err
    (state,) = cs.watch(tmp_path, once=True)
    assert (state.runs[0].state, state.runs[0].why) == (
        "waiting",
        "only 1.0 of 1.5 s at rest so far",
    )


def test_command_prints_pose_check(tmp_path, capsys):
    posed_records.write_campaign(tmp_path, {"all": MANY})
    assert main(["check", str(tmp_path / "all.log"), "--campaign", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    for word in ("is usable", "Clock", "Poses", "Missing directions", "Y.delta_P", "m/s^2"):
        assert word in output
    assert "uncertainty of the whole campaign" not in output


@pytest.mark.parametrize("suffix", ["log", "tsv"])
def test_watch_counts_poses_while_recording(tmp_path, suffix):
    posed_records.write_campaign(tmp_path, {"all": MANY})
    description = (tmp_path / "campaign.toml").read_text("utf-8")
    (tmp_path / "campaign.toml").write_text(description.replace("all.log", f"all.{suffix}"))
    text = (tmp_path / "all.log").read_text("utf-8")
    (tmp_path / "all.log").unlink()
    if suffix == "tsv":
        text = text.replace(" ", "\t")
    file = tmp_path / f"all.{suffix}"
    states = cs.watch(tmp_path, pace=cs.Pace(interval=0.01, share=1.0), goals={"X.K_F": "1e-3 g"})
    state = next(states)
    assert (state.runs[0].state, state.runs[0].why) == ("waiting", "no file yet")
    counts = []
    lines = text.splitlines(keepends=True)
    for part in (60, 900, 6000, len(lines)):
        whole = "".join(lines[:part])
        file.write_text(whole if part == len(lines) else whole + lines[part][:4], "utf-8")
        state = next(states)
        (run,) = state.runs
        assert run.rows in (part, 0)
        counts.append(run.poses.count if run.poses else run.why)
        assert state.goals[0].met == (part > 5000)
    states.close()
    assert counts[0] == "only 0.6 of 1.5 s at rest so far"
    assert counts[1:] == [sum(MANY.start + 1.5 < n / 100.0) for n in (900, 6000, len(lines))]
    result = cs.calibrate(tmp_path)
    assert [(c.value, c.u) for c in state.coefficients] == [
        (c.value, c.u) for c in map(result.coefficient, [c.name for c in state.coefficients])
    ]
    assert not state.complete
    assert "poses: 24" in str(state)


def test_unknown_run_and_campaign_without_records_raise(tmp_path):
    posed_records.write_campaign(tmp_path, {"all": MANY})
    with pytest.raises(CampaignError, match='no run is named "al"'):
        cs.check(tmp_path / "all.log", tmp_path, run="al")
    values = triads.compute_indications(triads.draw_directions(20, np.random.default_rng(1)))
    folder = triads.write_pose_campaign(tmp_path / "table", values)
    with raises("method-not-applicable"):
        next(iter(cs.watch(folder, once=True)))
