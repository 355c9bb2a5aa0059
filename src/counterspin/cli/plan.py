"""`counterspin plan`: the optimal campaign within limits, or a forecast of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OutputFile,
    SaveOptions,
    command,
    option_group,
    print_output,
    quote_path,
)
from counterspin.errors import CampaignError, UsageError, error_code
from counterspin.frozen import frozen


@option_group
@frozen
class ExampleOptions:
    """Writing of an example, instead of planning.

    Parameters
    ----------
    init
        Write a commented example to this file and exit.
    example
        With --init: example for `records` of a double turntable, or for `poses` of a triad.
    """

    init: Path | None = None
    example: Literal["records", "poses"] = "records"


@option_group
@frozen
class RecordingDetails:
    """Recording of the runs, if the campaign does not state it.

    Parameters
    ----------
    sampling_rate
        With --check: sampling rate of the records, such as "50 Hz", if the campaign does not
        state it.
    revolutions
        With --check: number of revolutions of runs whose duration the campaign does not state.
    """

    sampling_rate: str | None = None
    revolutions: float | None = None


_NO_DETAILS = RecordingDetails()
_NO_EXAMPLE = ExampleOptions()


@command
def plan(
    file: Path | None = None,
    *,
    check: Path | None = None,
    example_options: ExampleOptions = _NO_EXAMPLE,
    output: OutputFile = None,
    save_options: SaveOptions = NO_RESULT_FILE,
    recording_details: RecordingDetails = _NO_DETAILS,
) -> None:
    """Optimise rates, durations, senses and attitudes of the runs, and predict the uncertainties.

    Parameters
    ----------
    file
        Plan file with limits and goal.
    check
        Only predict the uncertainties of the campaign in this folder.
    output
        Folder for the campaign.toml of the planned campaign. An existing campaign.toml is not
        replaced.
    """
    from counterspin.campaign.field_types import parse_exact
    from counterspin.planning.plan import check as forecast
    from counterspin.planning.plan import plan as make_plan
    from counterspin.planning.plan import require_no_campaign, write_campaign, write_example
    from counterspin.planning.result import PlanResult
    from counterspin.reports.text import make_console, show_progress

    if sum(argument is not None for argument in (file, check, example_options.init)) != 1:
        raise UsageError("plan", ["give a plan file, --check DIR, or --init FILE"])
    if check is None and (recording_details.sampling_rate or recording_details.revolutions):
        raise UsageError("plan", ["--sampling-rate and --revolutions require --check DIR"])
    if example_options.init is None and example_options.example != "records":
        raise UsageError("plan", ["--example requires --init FILE"])
    if example_options.init is not None:
        example = write_example(example_options.init, example_options.example)
        print_output(f"Wrote {example}. Edit this file, or run the example plan:")
        print_output(f"  counterspin plan {quote_path(example_options.init)}")
        return
    save_options.check_writable(PlanResult.file_kind)
    if output is not None:
        require_no_campaign(output)
    if check is not None:
        if output is not None:
            raise UsageError("plan", ["--output requires a plan, not --check"])
        try:
            rate_text = recording_details.sampling_rate
            rate = None if rate_text is None else parse_exact(rate_text, "Hz")
        except ValueError as error:
            raise CampaignError("--sampling-rate", [str(error)], code=error_code(error)) from error
        result = forecast(check, sampling_rate=rate, revolutions=recording_details.revolutions)
    else:
        assert file is not None  # one of the three is
        with show_progress(labels=("Searching",) * 3):
            planned_campaign = make_plan(file)
        result = planned_campaign.result
    with save_options.saving(result):
        path = None if output is None else write_campaign(planned_campaign, output)
        make_console().print(result)
    if output is not None and result.readings:
        print_output("", f"Wrote {path}. Replace each ? with the reading, then calibrate:")
        print_output(f"  counterspin calibrate {quote_path(output)}")
    elif output is not None and path is not None:
        print_output("", f"Wrote {path}. Record the runs, or simulate them:")
        print_output(
            f"  counterspin simulate {quote_path(path)} -o {quote_path(output / 'simulated')}"
        )
