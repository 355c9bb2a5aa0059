"""Records of a small campaign in memory, and what its description says without them."""

import tomllib
from functools import cache

import campaigns
import numpy as np

from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.validation import Problems
from counterspin.simulation.simulate import simulate_run


def small():
    """Return the description of `campaigns.SMALL` as a mapping, to be changed at will."""
    return tomllib.loads(campaigns.SMALL)


def untrue():
    """Return the same without its truth and without the names of records."""
    document = {k: v for k, v in small().items() if k not in ("truth", "simulation", "schema")}
    document["runs"] = [{k: run[k] for k in ("name", "rate")} for run in document["runs"]]
    return document


@cache
def arrays(folder, seed=1):
    """Return run's name -> columns of the small campaign, simulated; not to be changed."""
    document = small()
    campaign = resolve_campaign(document, folder / "campaign.toml", Problems(document))
    streams = np.random.SeedSequence(seed).spawn(len(campaign.runs))
    return {
        run.name: simulate_run(campaign, run, np.random.default_rng(stream))
        for run, stream in zip(campaign.runs, streams, strict=True)
    }
