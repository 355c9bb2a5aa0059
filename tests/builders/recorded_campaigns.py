"""Campaigns as a laboratory has them: records, whose description says no truth and no length."""

from campaigns import write

from counterspin.campaign.simulation import simulate
from counterspin.campaign.toml_file import load_document
from counterspin.toml_text import write_document


def record(folder, plan, text, *without):
    """Simulate a description's records into a folder, and say no more than a laboratory knows.

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
    simulate(write(plan, text, "plan.toml"), folder)
    document = load_document(folder / "campaign.toml")
    for key in ("simulation", "truth", *without):
        document.pop(key, None)
    for run in document["runs"]:
        for key in ("revolutions", "truth"):
            run.pop(key, None)
    write(folder, write_document(document))
    return folder
