"""Drifts and tilts of the platform beyond first order."""

import math

import numpy as np
import pytest
from campaigns import SMALL, replace_parts, write_description

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.checks.small_angles import check_drifts
from counterspin.calibration.result_parts import Coefficient
from counterspin.inference.joint.unknowns import Unknown
from counterspin.physics.terms import DEGREE_PER_HOUR
from counterspin.simulation.simulate import simulate

ARCMIN = math.radians(1.0 / 60.0)

#: No exact inputs; the same noise in each simulation.
QUIET = replace_parts(
    SMALL,
    ('"1.002 g/g"\ndisp', '"1.002 ± 1e-4 g/g"\ndisp'),
    ('"0.999 g/g"\ndisp', '"0.999 ± 1e-4 g/g"\ndisp'),
    ('displacement = "0.01 m"', 'displacement = "0.0002 m"'),
    ("[truth.spindle]", '[truth.platform]\ntilt = { north = "TILT" }\n\n[truth.spindle]'),
)


def calibrate_tilted(folder, tilt, prior, key="held"):
    model = {"held": "hold", "estimated": "terms"}[key]
    listed = '["platform.tilt.north"]'
    if key == "estimated":
        listed = '["K_F", "K_I", "K_II", "K_III", "platform.tilt.north"]'
    text = replace_parts(
        QUIET,
        ("TILT", tilt),
        (
            '[model]\nassume = "all"\n',
            f'[model]\nassume = "all"\n{model} = {listed}\n'
            f'priors = {{ "platform.tilt.north" = "{prior}" }}\n',
        ),
    )
    simulate(write_description(folder, text, "plan.toml"), folder / "records", overwrite=True)
    return calibrate(folder / "records")


def large_tilt_findings(result):
    return {f.subject: f for f in result.findings if f.code == "large-tilt"}


@pytest.mark.parametrize("key", ["held", "estimated"])
def test_second_order_of_tilt_changes_named_coefficients(tmp_path, key):
    level = calibrate_tilted(tmp_path / "level", "0 arcsec", "0 ± 0.1 arcsec", key)
    tilted = calibrate_tilted(tmp_path / "tilted", "20 arcmin", "1200 ± 0.1 arcsec", key)
    assert large_tilt_findings(level) == {}
    findings = large_tilt_findings(tilted)
    assert set(findings) == {"Qx.K_I"}
    first, second = (r.accelerometers["Qx"].coefficients["K_I"] for r in (level, tilted))
    # -psi^2/2 and, from K_II (a_I - psi)^2, -2 K_II psi
    expected = -0.5 * (20 * ARCMIN) ** 2 - 2.0 * 2.7e-5 * 20 * ARCMIN
    assert second.value - first.value == pytest.approx(expected, abs=0.3 * second.u)
    assert findings["Qx.K_I"].size == pytest.approx(-expected / second.u, rel=0.02)
    assert findings["Qx.K_I"].size > 1.0
    assert tilted.state == "reservations"
    assert "may reach 1.2e+03 arcsec (estimate plus 2 u)" in findings["Qx.K_I"].text


def test_tilt_about_input_axis_does_not_change_scale_factor(tmp_path):
    findings = large_tilt_findings(calibrate_tilted(tmp_path, "20 arcmin", "1200 ± 0.1 arcsec"))
    # Tilt about north, the input axis of Qy.
    assert "Qy.K_I" not in findings


@pytest.mark.parametrize(
    ("drift", "u", "longest", "words"),
    [
        (0.3, 1e-6, 400.0, "is 0.3 deg/h"),
        (0.1, 1e-6, 400.0, ""),
        (0.1, 0.04, 400.0, ""),
        (0.1, 0.06, 400.0, "may reach 0.22 deg/h"),
        (0.3, 1e-6, 100.0, ""),
        (0.1, 1e-6, 800.0, "is 0.1 deg/h"),
    ],
)
def test_drift_limit_depends_on_duration_of_runs(drift, u, longest, words):
    # g d^2 T^4/24 reaches 0.01 m at 0.2 deg/h over 400 s, and at 0.05 deg/h over 800 s.
    unknown = Unknown("", "platform.drift.north", (0.0, np.inf), 1e-4)
    value, u = -drift * DEGREE_PER_HOUR, u * DEGREE_PER_HOUR
    fitted = Coefficient(value=value, u=u, unit="rad/s", estimated=True)
    findings = check_drifts({unknown: fitted}, longest)
    assert len(findings) == bool(words)
    assert all(words in finding.text for finding in findings)
    assert all(finding.subject == "platform.drift.north" for finding in findings)
