"""Studies and forecasts of poses at unknown attitudes."""

import numpy as np
import pytest

import counterspin as cs
import triads


def _campaign(folder, count=24, noise="0.3 mg", u=None):
    truth = "".join(
        f'[truth.{name}]\nK_F = "{bias} g"\n'
        for name, bias in zip(triads.NAMES, triads.BIAS, strict=True)
    )
    spread = "" if u is None else f" ± {u}"
    values = ", ".join(f'{name} = "?{spread} mg"' for name in triads.NAMES)
    runs = "".join(
        f'[[runs]]\nname = "p{k}"\nmotion = "static"\nattitude = "unknown"\n'
        f"reading = {{ {values} }}\n"
        for k in range(count)
    )
    known = "" if noise is None else f'[truth.noise]\nreading = "{noise}"\n'
    folder.mkdir()
    (folder / "campaign.toml").write_text(
        triads.format_description() + runs + truth + known + "[simulation]\nseed = 5\n"
    )
    return folder


def test_scatter_of_trials_matches_u(tmp_path):
    trials = 50
    result = cs.study(_campaign(tmp_path / "poses"), trials=trials, seed=2)
    (analysis,) = result.analyses.values()
    (coefficient,) = [c for name, c in analysis.coefficients.items() if name == "Z.K_I"]
    # A standard deviation of n trials is known to 1/sqrt(2n) of it: 4 of these.
    assert coefficient.sd == pytest.approx(coefficient.u, rel=4.0 / np.sqrt(2.0 * trials))
    assert abs(coefficient.bias) < 4.0 * coefficient.sd / np.sqrt(trials)


def test_forecast_matches_calibration(tmp_path):
    folder = _campaign(tmp_path / "poses", noise=None, u="0.3")
    cs.simulate(folder, tmp_path / "made")
    result = cs.calibrate(tmp_path / "made")
    expected = cs.forecast(tmp_path / "made").u
    for name in ("X.K_F", "Y.delta_P", "Z.K_I"):
        assert result.coefficient(name).u == pytest.approx(expected[name], rel=0.05)
    with pytest.raises(cs.CounterspinError, match="has no value"):
        cs.forecast(folder)
