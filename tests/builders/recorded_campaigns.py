"""Campaigns of a laboratory: records, and a description without truth and length."""

import numpy as np
import polars as pl
from campaigns import write_description

from counterspin.campaign.documents import load_document
from counterspin.simulation.simulate import simulate
from counterspin.toml_text import format_document

#: True noise of a sample of the two columns of a record at rest, m.
WHITE_NOISE = {"east_m": 0.01, "north_m": 0.0101}


def simulate_measured_campaign(folder, plan, text, *without):
    """Simulate records into a folder, with a description without truth and simulation keys.

    Parameters
    ----------
    folder
        What is recorded.
    plan
        Another folder, which takes what is simulated.
    text
        Its description.
    *without
        Further sections that are left out.
    """
    simulate(write_description(plan, text, "plan.toml"), folder)
    document = load_document(folder / "campaign.toml")
    for key in ("simulation", "truth", *without):
        document.pop(key, None)
    for run in document["runs"]:
        for key in ("revolutions", "truth"):
            run.pop(key, None)
    write_description(folder, format_document(document))
    return folder


def write_static_record(folder, rows=4000, **columns):
    """Write a record at rest at 20 Hz: white noise and, over an offset, a constant force."""
    rng = np.random.default_rng(5)
    time = np.arange(rows) / 20.0
    signals = {
        name: 3.0 + 1e-3 * time**2 + white * rng.standard_normal(rows)
        for name, white in WHITE_NOISE.items()
    }
    pl.DataFrame({"time_s": time, **signals, **columns}).write_csv(folder / "rest.csv")
    return folder
