"""Plots of data and fit of a run with the parabola removed."""

import numpy as np
import pytest
from served import InlineJobs

from counterspin.application.record_plots import subtract_polynomial
from counterspin.calibration.result import Result

RUN = {"name": "three", "run": "fast", "fit": True}


def test_data_minus_fit_equals_residuals(page, app, folder):
    assert page.get("/api/record-about", params=RUN).json() == {"overview": None}
    app.jobs = InlineJobs()
    assert page.post("/api/fit", json={"name": "three"}).json()["state"] == "done"
    about = page.get("/api/record-about", params=RUN).json()["overview"]
    assert about["columns_per_plot"] == 2
    assert [column["name"] for column in about["columns"]] == [
        "Qx: data, parabola removed",
        "Qx: fit, parabola removed",
        "Qy: data, parabola removed",
        "Qy: fit, parabola removed",
    ]
    window = RUN | {"low": about["first"], "high": about["last"], "parts": 4000}
    body = page.get("/api/record", params=window).json()
    assert body["is_complete"]
    data, fitted = (np.array(column, float) for column in body["columns"][:2])
    trace = Result.read(folder / "three" / "result.json").accelerometers["Qx"].traces["fast"]
    assert np.sqrt(np.mean((data - fitted) ** 2)) == pytest.approx(trace.rms, rel=1e-3)
    # 2.7e-5 g/g^2 at 1 rev/s is a harmonic of 1 mm, and the bias a parabola of metres.
    assert 1e-5 < np.ptp(fitted) < 0.1
    time = np.array(body["time"])
    powers = np.vander(time, 3)
    assert np.abs(powers.T @ data).max() < 1e-6 * np.abs(powers.T @ np.abs(data)).max()


def test_changed_description_requires_new_fit(page, app, folder):
    app.jobs = InlineJobs()
    page.post("/api/fit", json={"name": "three"})
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text(encoding="utf-8") + "\n# changed\n", encoding="utf-8")
    assert page.get("/api/record-about", params=RUN).json() == {"overview": None}


def test_rejects_fit_plot_of_readings(page):
    page.post("/api/campaign", json={"name": "rest", "test": "tumble"})
    refused = page.post("/api/fit", json={"name": "rest"})
    assert refused.status_code == 422
    assert refused.json()["code"] == "method-not-applicable"


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_detrending_removes_only_polynomial(degree):
    time = np.linspace(0.0, 400.0, 1000)
    wave = subtract_polynomial(time, np.sin(time), degree)
    more = subtract_polynomial(time, np.sin(time) + 3.0 * time**degree - 1.0, degree)
    assert more == pytest.approx(wave, abs=1e-9 * 400.0**degree)
