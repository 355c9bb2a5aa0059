"""[study]: quantities that vary from trial to trial, and competing analyses.

It is a section of ``campaign.toml``, next to [truth], or of a file that names the campaign:

    schema = 1
    campaign = "three-rate"              # the campaign's folder or file, from here
    [study]
    ...
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, create_model

from counterspin.calibration.model import inputs_by_owner, make_unknowns
from counterspin.calibration.options import TwoStageOptions
from counterspin.campaign.description import Campaign, resolve_campaign
from counterspin.campaign.documents import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    KeyPath,
    campaign_error,
    description_file,
    load_document,
    require_source,
)
from counterspin.campaign.field_types import (
    Schema,
    SettingsSection,
    Text,
    TextList,
    key_field,
    parse_exact,
)
from counterspin.campaign.quantity import parse_quantity
from counterspin.campaign.resolution import CampaignDocument
from counterspin.campaign.runs import recorders_of
from counterspin.campaign.terms import BARE_NAMES, acting_rows, expand_name, shown_symbols
from counterspin.campaign.validation import Problems, Section, suggest_name
from counterspin.errors import OutOfRangeError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import CLOCK
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS, SHARED_TERMS, term
from counterspin.simulation.simulable import check_size, reading_problems, simulation_problems
from counterspin.studies.draws import (
    NOISE_LEVEL_UNITS,
    OTHER_QUANTITY_UNITS,
    WHITE_NOISE,
    VariedQuantity,
)
from counterspin.studies.simulation_setup import expand_pose_records, set_pose_noise

#: Names of the distributions.
_DISTRIBUTIONS: Final = ("normal", "uniform", "fixed")


def _check_analysis_name(analysis: str) -> str:
    if not analysis.replace("-", "").replace("_", "").isalnum():
        raise ValueError("the name of an analysis may contain only letters, digits, - and _")
    return analysis


class AnalysisSettings(SettingsSection):
    """[study.analyses.NAME]: an analysis to compare."""

    method: Literal["two-stage", "joint"] = key_field("calibration method", "joint")
    model: Literal["exact", "as-printed"] = key_field(
        "equations of the two-stage method", "as-printed", "exact"
    )
    weighted: bool = key_field(
        "whether the second stage of the two-stage method weights the runs", False, True
    )
    ripple: Literal["amplitude", "ratio"] = key_field(
        "quantity that the runs share in the two-stage method: the amplitude of the rate ripple, "
        "or its ratio to the rate",
        "ratio",
        "amplitude",
    )
    fit_bias: bool = key_field("whether the second stage fits a bias", False, True)
    sigma: Literal["given", "residuals"] = key_field(
        "source of the strobe noise: the given value, or an estimate from the residuals",
        "residuals",
        "given",
    )
    terms: list[Text] | None = key_field(
        "requested terms; replaces `terms` of `[model]`",
        ["K_F", "K_II"],
        None,
        absent="the campaign's",
    )
    assume: TextList | None = key_field(
        "terms and inputs assumed perfect; replaces `assume` of `[model]`",
        ["K_OO"],
        None,
        absent="the campaign's",
    )
    hold: list[Text] | None = key_field(
        "considered terms and inputs; replaces `hold` of `[model]`",
        ["K_PP"],
        None,
        absent="the campaign's",
    )
    considered: list[Text] | None = key_field("former name of `hold`", ["K_PP"], None)


class DistributionSettings(SettingsSection):
    """[study.vary.NAME]: distribution of a quantity."""

    normal: Any = key_field(
        "mean ± standard deviation of a normal distribution",
        "2e-5 ± 1e-6 g/g^2",
        None,
        kind="quantity ±",
    )
    uniform: Any = key_field(
        "lowest and highest value of a uniform distribution",
        ["-1e-7 1/s", "1e-7 1/s"],
        None,
        kind="two quantities",
    )
    fixed: Any = key_field("value that is the same in every trial", "0.02 m", None, kind="quantity")
    per: Literal["run", "campaign"] = key_field(
        "whether each run has a separate random value", "run", "campaign"
    )


class StudySettings(SettingsSection):
    """[study]: varied quantities and compared analyses."""

    trials: Annotated[int, Field(ge=2, le=10**9)] = key_field(
        "number of campaigns to simulate and calibrate", 2000, 10_000
    )
    seed: Annotated[int, Field(ge=0)] = key_field("seed of the random number generator", 1, 1)
    vary: Annotated[dict[str, Any], Section(dict[str, DistributionSettings])] = key_field(
        "quantities that vary from trial to trial: a table with the distribution of each",
        {"centrifuge.radius": {"normal": "2.5 ± 1e-5 m"}},
        absent="nothing",
        default_factory=dict,
    )
    analyses: Annotated[
        dict[Annotated[str, AfterValidator(_check_analysis_name)], Any],
        Section(dict[str, AnalysisSettings]),
    ] = key_field(
        "analyses to compare, by name",
        {"joint": {"method": "joint"}},
        absent="joint fit, two-stage method, and two-stage method as printed",
        default_factory=dict,
    )


class StudyDocument(SettingsSection):
    """A study in a file of its own, beside the campaign that it names."""

    schema_version: Schema = key_field("version of this format", 1, alias="schema")
    campaign: Text = key_field("folder or description of the campaign", "campaign")
    study: Annotated[dict[str, Any], Section(StudySettings)] = key_field(
        "varied quantities and compared analyses", {}
    )


#: ``campaign.toml`` with the section [study].
StudyCampaignDocument = create_model(
    "StudiedDocument",
    __base__=CampaignDocument,
    __doc__=CampaignDocument.__doc__,
    study=(
        Annotated[dict[str, Any] | None, Section(StudySettings)],
        CampaignDocument.model_fields["study"],
    ),
)


@frozen
class AnalysisDescription:
    """One of the competing analyses."""

    name: str  #: Name of the analysis in the study.
    two_stage: TwoStageOptions | None  #: Options of the two-stage method; None: the joint fit.
    campaign: Campaign  #: Campaign with the [model] of this analysis.


@frozen
class StudyDescription:
    """A study."""

    campaign: Campaign  #: Simulated campaign with [truth].
    trials: int  #: Number of trials.
    seed: int  #: Seed of the random number generator.
    varied_quantities: tuple[VariedQuantity, ...]  #: Varied quantities, in the order of the file.
    analyses: tuple[AnalysisDescription, ...]  #: Analyses to compare.


#: Default analyses: the two methods, and the equations of the paper. Only the first applies to
#: readings and to records of velocity and specific force.
_DEFAULT_ANALYSES: Final[Mapping[str, Mapping[str, Any]]] = {
    "joint": {"method": "joint"},
    "two-stage": {"method": "two-stage"},
    "as-printed": {"method": "two-stage", "model": "as-printed", "weighted": False},
}


def read_study(path: Path | str | Campaign) -> StudyDescription:
    """Read and check a study.

    path: Folder or description of a campaign, file of a study, or a `Campaign`.
    """
    if not isinstance(path, Campaign):
        file = description_file(path)
        return parse_study(load_document(file, CAMPAIGN_ADVICE, "campaign"), file)
    return parse_study(
        dict(require_source(path).document), path.path, path.folder / DESCRIPTION_NAME
    )


def parse_study(
    raw_document: dict[str, Any], file: Path, campaign_file: Path | None = None
) -> StudyDescription:
    """Read and check the document of a study; raise the errors of `read_study`.

    campaign_file: Description of the campaign; None: `raw_document` may name another file.
    """
    problems = Problems(raw_document)
    document, source_file = (
        (raw_document, campaign_file)
        if campaign_file
        else _load_campaign_document(raw_document, file, problems)
    )
    file_names = () if source_file in (file, campaign_file) else (str(source_file),)
    campaign = _resolve_campaign(document, source_file, problems, file_names)
    study_section = raw_document.get("study", {})
    settings = problems.check(StudySettings, study_section, ("study",))
    if campaign is None or settings is None:
        raise campaign_error(file, problems.lines)
    if campaign.simulation is None:
        problems.add(
            ("truth",),
            "missing; a study requires [truth.NAME] with the true coefficients",
            "missing-key",
        )
    else:
        check_size(campaign, campaign.simulation.sampling_rate, "study")
    problems.lines += [*simulation_problems(campaign), *reading_problems(campaign)]
    records = campaign.triad.records if campaign.triad else ()
    if records and not problems.lines:
        document = expand_pose_records(document, campaign)
        expanded_campaign = _resolve_campaign(document, source_file, problems, file_names)
        campaign = expanded_campaign and set_pose_noise(expanded_campaign, records)
        if campaign is None:
            raise campaign_error(file, problems.lines)
    recorders = recorders_of(document.get("records", {}), campaign.runs)
    quantities: list[VariedQuantity] = []
    for key, entry_path, entry in _walk_entries(settings.vary, ("study", "vary")):
        quantities += _parse_quantities(key, entry_path, entry, campaign, recorders, problems)
    for index, quantity in enumerate(quantities):
        if any(_is_same_quantity(quantity, previous) for previous in quantities[:index]):
            problems.add(("study", "vary"), f"{quantity.symbol} is listed twice", "duplicate-entry")
    analyses = []
    has_readings = campaign.readings or campaign.posed
    has_only_displacement = {
        accelerometer.observable for accelerometer in campaign.accelerometers.values()
    } == {"displacement"}
    default_analyses = (
        {"joint": _DEFAULT_ANALYSES["joint"]}
        if has_readings or not has_only_displacement
        else _DEFAULT_ANALYSES
    )
    for name, table in (settings.analyses or default_analyses).items():
        is_two_stage = isinstance(table, Mapping) and table.get("method") == "two-stage"
        if is_two_stage and (has_readings or not has_only_displacement):
            data_text = "readings" if has_readings else "records of velocity or specific force"
            problems.add(
                ("study", "analyses", name, "method"),
                "the two-stage method requires records of displacement on a double turntable; "
                f"this campaign has {data_text}, which require the joint method",
                "method-not-applicable",
            )
            continue
        analysis = _parse_analysis(name, table, document, source_file, problems)
        if analysis is not None:
            analyses.append(analysis)
    if problems.lines:
        raise campaign_error(file, problems.lines)
    quantities += _prior_quantities(campaign, quantities)
    return StudyDescription(
        campaign, settings.trials, settings.seed, tuple(quantities), tuple(analyses)
    )


def _prior_quantities(
    campaign: Campaign, quantities: Sequence[VariedQuantity]
) -> Iterator[VariedQuantity]:
    """Yield the nuisance parameters with their stated or default priors as varied quantities.

    Omit parameters that vary already, or have a value in [truth].
    """
    assert campaign.simulation is not None
    truth = campaign.simulation.truth
    excluded_keys = {(quantity.owner, quantity.symbol) for quantity in quantities}
    excluded_keys |= {
        (name, symbol)
        for name, coefficients in truth.coefficients.items()
        for symbol in coefficients
    }
    excluded_keys |= {("", symbol) for symbol in truth.machine} | truth.inputs.keys()
    excluded_keys |= {("", symbol) for run in truth.runs.values() for symbol in run.shared}
    stated_inputs = inputs_by_owner(campaign)
    model = make_unknowns(campaign)
    for parameter in (*model.unknowns, *model.considered):
        owner = parameter.owner if parameter.symbol in {**ACCELEROMETER_TERMS, **INPUTS} else ""
        if (
            parameter.is_of_interest
            or parameter.prior[1] == 0.0
            or (owner, parameter.symbol) in excluded_keys
        ):
            continue
        excluded_keys.add((owner, parameter.symbol))
        value, u = parameter.prior
        mean = stated_inputs[owner, parameter.symbol].value if parameter.symbol in INPUTS else value
        yield VariedQuantity(
            owner,
            parameter.symbol,
            "normal",
            mean,
            u,
            term(parameter.symbol).per_run,
            parameter.correlations,
        )


def _load_campaign_document(
    raw: dict[str, Any], file: Path, problems: Problems
) -> tuple[Mapping[str, Any], Path]:
    """Return the document and file of the campaign: `raw`, or the file that `raw` names."""
    if not isinstance(raw.get("campaign"), str):
        return raw, file
    campaign_file = description_file(file.parent / raw["campaign"])
    known_keys = ("schema", "campaign", "study")
    for key in raw:
        if key not in known_keys:
            problems.add((key,), "unknown key" + suggest_name(key, known_keys), "unknown-key")
    if type(raw.get("schema")) is not int or raw["schema"] != 1:
        problems.add(
            ("schema",), "this version of counterspin supports schema = 1", "unknown-choice"
        )
    return load_document(campaign_file, CAMPAIGN_ADVICE, "campaign"), campaign_file


def _resolve_campaign(
    document: Mapping[str, Any], file: Path, problems: Problems, prefix: KeyPath
) -> Campaign | None:
    """Return the campaign of a document, or None after reporting its problems."""
    campaign_problems = Problems(document)
    campaign = resolve_campaign(document, file, campaign_problems)
    line_prefix = f"{prefix[0]}: " if prefix else ""
    problems.lines += [
        line_prefix + line for line in campaign_problems.lines if line not in problems.lines
    ]
    return campaign


def _is_same_quantity(quantity: VariedQuantity, other_quantity: VariedQuantity) -> bool:
    ripple_symbols = {"spindle.ripple.ratio", "spindle.ripple.amplitude"}
    if {quantity.symbol, other_quantity.symbol} == ripple_symbols:
        return True
    return (quantity.owner, quantity.symbol) == (other_quantity.owner, other_quantity.symbol)


def _walk_entries(
    table: Mapping[str, Any], path: KeyPath, prefix: str = ""
) -> Iterator[tuple[str, KeyPath, Any]]:
    """Yield name, path and entry of each quantity; join the keys of nested tables by dots."""
    for key, value in table.items():
        is_nested = isinstance(value, Mapping) and not any(name in value for name in _DISTRIBUTIONS)
        if is_nested and value and all(isinstance(entry, Mapping) for entry in value.values()):
            yield from _walk_entries(value, (*path, key), f"{prefix}{key}.")
        else:
            yield prefix + key, (*path, key), value


def _parse_quantities(
    key: str,
    path: KeyPath,
    entry: Any,
    campaign: Campaign,
    recorders: Mapping[str, str],
    problems: Problems,
) -> list[VariedQuantity]:
    settings = problems.check(DistributionSettings, entry, path)
    names = _resolve_names(key, path, campaign, recorders, problems)
    if settings is None or not names:
        return []
    distributions = [name for name in _DISTRIBUTIONS if getattr(settings, name) is not None]
    if len(distributions) != 1:
        problems.add(path, "give one of normal, uniform and fixed", "unknown-choice")
        return []
    (distribution,) = distributions
    symbol = names[0][1]
    unit = OTHER_QUANTITY_UNITS.get(symbol) or unit_of(symbol)
    parameters = problems.collect(
        path,
        _parse_distribution,
        distribution,
        getattr(settings, distribution),
        unit,
        campaign.gravity.value,
    )
    is_per_run = settings.per == "run"
    if is_per_run and (symbol in (*INPUTS, *NOISE_LEVEL_UNITS) or not campaign.runs):
        problems.add(
            path,
            "this quantity is the same in all runs and readings of a campaign; remove the key "
            "`per`",
        )
    if parameters is None:
        return []
    first, second = parameters
    if symbol == WHITE_NOISE and first <= 0.0:
        problems.add(path, "must be greater than zero", "value-out-of-range")
    if symbol in INPUTS:
        low, high = term(symbol).effect.bounds
        if not all(
            low <= value <= high
            for value in (first, second if distribution == "uniform" else first)
        ):
            problems.add(
                path, f"must be between {low:.4g} and {high:.4g} {unit}", "value-out-of-range"
            )
    if symbol in NOISE_LEVEL_UNITS and first < 0.0:
        problems.add(path, "must not be less than zero", "value-out-of-range")
    return [
        VariedQuantity(owner, quantity_symbol, distribution, first, second, is_per_run)  # type: ignore[arg-type]
        for owner, quantity_symbol in names
    ]


def _resolve_names(
    key: str, path: KeyPath, campaign: Campaign, recorders: Mapping[str, str], problems: Problems
) -> list[tuple[str, str]]:
    """Return owner and symbol of each quantity with a name."""
    owner, _, symbol_name = key.partition(".")
    if owner in campaign.accelerometers and symbol_name in ACCELEROMETER_TERMS:
        return [(owner, symbol_name)]
    if key in ACCELEROMETER_TERMS:
        return [(name, key) for name in campaign.accelerometers]
    observable_symbols = shown_symbols(campaign.readings)
    if key in INPUTS or symbol_name in INPUTS:
        return _resolve_inputs(key, path, campaign, recorders, problems)
    if key in OTHER_QUANTITY_UNITS and not campaign.runs:
        problems.add(
            path, "this quantity requires double-turntable records, but the campaign contains none"
        )
    shared_symbols = (key,) if key in SHARED_TERMS or key in OTHER_QUANTITY_UNITS else ()
    if symbols := shared_symbols or expand_name(key, observable_symbols):
        return [("", symbol) for symbol in symbols]
    if key in BARE_NAMES:
        mountings = [accelerometer.mounting for accelerometer in campaign.accelerometers.values()]
        rows = acting_rows(key, mountings, [run.attitude for run in campaign.runs])
        return [("", row.symbol) for row in rows]
    candidates = [
        *OTHER_QUANTITY_UNITS,
        *ACCELEROMETER_TERMS,
        *BARE_NAMES,
        *SHARED_TERMS,
        *observable_symbols,
    ]
    hint = suggest_name(key, candidates)
    if "known:" in hint:
        hint = f"; known: {', '.join([*OTHER_QUANTITY_UNITS, *ACCELEROMETER_TERMS, *BARE_NAMES])}"
    problems.add(path, "cannot be varied in a study" + hint, "unknown-term")
    return []


def _resolve_inputs(
    key: str, path: KeyPath, campaign: Campaign, recorders: Mapping[str, str], problems: Problems
) -> list[tuple[str, str]]:
    """Return owner and symbol of an input; without an owner, return those of all owners."""
    name, _, symbol_name = key.partition(".")
    symbol = key if key in INPUTS else symbol_name
    owner = recorders.get(name) if symbol == CLOCK else name
    matches = [
        (input_owner, input_symbol)
        for input_owner, input_symbol in inputs_by_owner(campaign)
        if input_symbol == symbol and (key in INPUTS or input_owner == owner)
    ]
    if not matches:
        problems.add(path, "does not apply to any record or reading of this campaign")
    return matches


def _parse_distribution(
    distribution: str, value: Any, unit: str, gravity: float
) -> tuple[float, float]:
    """Return the two parameters of a distribution."""
    if distribution == "normal":
        quantity = parse_quantity(_ratio_to_quantity(value, unit), unit, gravity=gravity)
        if quantity.u <= 0.0:
            raise ValueError('write a normal distribution as "MEAN ± SD UNIT"')
        return quantity.value, quantity.u
    if distribution == "fixed":
        return parse_exact(_ratio_to_quantity(value, unit), unit, gravity), 0.0
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError('write a uniform distribution as ["LOWEST UNIT", "HIGHEST UNIT"]')
    low, high = (parse_exact(_ratio_to_quantity(bound, unit), unit, gravity) for bound in value)
    if not low < high:
        raise OutOfRangeError("the lowest value must be below the highest")
    return low, high


def _ratio_to_quantity(value: Any, unit: str) -> Any:
    """Return a plain number as a quantity in ppm if the unit is a ratio."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return f"{float(value) * 1e6!r} ppm" if is_number and unit == "1" else value


def _parse_analysis(
    name: str, table: Any, document: Mapping[str, Any], file: Path, problems: Problems
) -> AnalysisDescription | None:
    path = ("study", "analyses", name)
    settings = problems.check(AnalysisSettings, table, path)
    if settings is None:
        return None
    if settings.method == "joint":
        for key in ("model", "weighted", "ripple", "fit_bias", "sigma"):
            if isinstance(table, Mapping) and key in table:
                problems.add((*path, key), "applies only to the two-stage method")
    n_errors = len(problems.lines)
    campaign = _resolve_campaign(
        _apply_terms(document, settings), file, problems, (".".join(path),)
    )
    if campaign is None or len(problems.lines) > n_errors:
        return None
    if settings.method == "joint":
        return AnalysisDescription(name, None, campaign)
    options = TwoStageOptions(
        model=settings.model,
        weighted=settings.weighted,
        ripple=settings.ripple,
        fit_bias=settings.fit_bias,
        from_residuals=settings.sigma == "residuals",
    )
    return AnalysisDescription(name, options, campaign)


def _apply_terms(document: Mapping[str, Any], settings: AnalysisSettings) -> dict[str, Any]:
    """Return the document of the campaign with the terms of an analysis."""
    model = dict(document.get("model", {}))
    if not (settings.terms is settings.hold is settings.considered is None):
        # Formerly considered terms may be among the new terms.
        model = {key: value for key, value in model.items() if key not in ("hold", "considered")}
    for key in ("terms", "assume", "hold", "considered"):
        if (names := getattr(settings, key)) is not None:
            model[key] = names
    return {**document, "model": model} if model else dict(document)
