"""Records of a small campaign in memory, and its description without records."""

import tomllib
from functools import cache

import campaigns
import numpy as np

from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.validation import Problems
from counterspin.simulation.simulate import simulate_run


def parse_small_description():
    """Return the description of `campaigns.SMALL` as a new mapping."""
    return tomllib.loads(campaigns.SMALL)


def parse_description_without_truth():
    """Return the description without its truth and without the names of records."""
    document = {
        k: v
        for k, v in parse_small_description().items()
        if k not in ("truth", "simulation", "schema")
    }
    document["runs"] = [{k: run[k] for k in ("name", "rate")} for run in document["runs"]]
    return document


@cache
def simulate_columns(folder, seed=1):
    """Simulate the small campaign and return run name -> columns; do not change them."""
    document = parse_small_description()
    campaign = resolve_campaign(document, folder / "campaign.toml", Problems(document))
    streams = np.random.SeedSequence(seed).spawn(len(campaign.runs))
    return {
        run.name: simulate_run(campaign, run, np.random.default_rng(stream))
        for run, stream in zip(campaign.runs, streams, strict=True)
    }
