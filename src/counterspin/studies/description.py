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
from counterspin.simulation.simulable import (
    check_size,
    reading_problems,
    simulation_problems,
)
from counterspin.studies.draws import NOISE_LEVELS, OTHER_QUANTITIES, WHITE, VariedQuantity
from counterspin.studies.simulation_setup import expand_pose_records, set_pose_noise

#: Kinds of distribution, as they are written.
_DISTRIBUTIONS: Final = ("normal", "uniform", "fixed")


def _analysis_name(analysis: str) -> str:
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
        "requested terms, instead of `[model]` `terms`",
        ["K_F", "K_II"],
        None,
        absent="the campaign's",
    )
    assume: TextList | None = key_field(
        "terms and inputs assumed perfect, instead of `[model]` `assume`",
        ["K_OO"],
        None,
        absent="the campaign's",
    )
    hold: list[Text] | None = key_field(
        "considered terms and inputs, instead of `[model]` `hold`",
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
        "quantities that vary from trial to trial, with their distributions by name",
        {"centrifuge.radius": {"normal": "2.5 ± 1e-5 m"}},
        absent="nothing",
        default_factory=dict,
    )
    analyses: Annotated[
        dict[Annotated[str, AfterValidator(_analysis_name)], Any],
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


#: ``campaign.toml`` with the section that studies read.
StudiedDocument = create_model(
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

    name: str  #: As the study calls it.
    two_stage: TwoStageOptions | None  #: How the two-stage method is applied; None: the joint fit.
    #: The campaign with the terms that this analysis asks for, assumes and holds.
    campaign: Campaign


@frozen
class StudyDescription:
    """A study."""

    campaign: Campaign  #: What is simulated, [truth] included.
    #: How many, and of the random numbers.
    trials: int
    seed: int
    varying: tuple[VariedQuantity, ...]  #: What varies, in the file's order.
    analyses: tuple[AnalysisDescription, ...]  #: What competes.


#: What competes where the study names nothing: the two methods, and the paper's equations. Of
#: readings, velocity and force only the first.
_DEFAULT_ANALYSES: Final[Mapping[str, Mapping[str, Any]]] = {
    "joint": {"method": "joint"},
    "two-stage": {"method": "two-stage"},
    "as-printed": {"method": "two-stage", "model": "as-printed", "weighted": False},
}


def read_study(path: Path | str | Campaign) -> StudyDescription:
    """Read and check a study.

    path: A campaign's folder or description, a study's own file, or a campaign already read.
    """
    if not isinstance(path, Campaign):
        file = description_file(path)
        return parse_study(load_document(file, CAMPAIGN_ADVICE, "campaign"), file)
    return parse_study(
        dict(require_source(path).document), path.path, path.folder / DESCRIPTION_NAME
    )


def parse_study(
    raw: dict[str, Any], file: Path, campaign_file: Path | None = None
) -> StudyDescription:
    """Read and check the content of a study's file; raise the errors of `read_study`.

    campaign_file: Path of the description of a campaign already read; None: `raw` may name another
        one.
    """
    problems = Problems(raw)
    document, source = (
        (raw, campaign_file) if campaign_file else _campaign_document(raw, file, problems)
    )
    file_names = () if source in (file, campaign_file) else (str(source),)
    campaign = _campaign(document, source, problems, file_names)
    section = raw.get("study", {})
    settings = problems.check(StudySettings, section, ("study",))
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
        expanded_campaign = _campaign(document, source, problems, file_names)
        campaign = expanded_campaign and set_pose_noise(expanded_campaign, records)
        if campaign is None:
            raise campaign_error(file, problems.lines)
    recorders = recorders_of(document.get("records", {}), campaign.runs)
    varying: list[VariedQuantity] = []
    for key, entry_path, entry in _walk_entries(settings.vary, ("study", "vary")):
        varying += _varied_quantities(key, entry_path, entry, campaign, recorders, problems)
    for index, quantity in enumerate(varying):
        if any(_is_same_quantity(quantity, earlier) for earlier in varying[:index]):
            problems.add(("study", "vary"), f"{quantity.symbol} is listed twice", "duplicate-entry")
    analyses = []
    has_readings = campaign.readings or campaign.posed
    only_displacement = {a.observable for a in campaign.accelerometers.values()} == {"displacement"}
    default = (
        {"joint": _DEFAULT_ANALYSES["joint"]}
        if has_readings or not only_displacement
        else _DEFAULT_ANALYSES
    )
    for name, table in (settings.analyses or default).items():
        two_stage = isinstance(table, Mapping) and table.get("method") == "two-stage"
        if two_stage and (has_readings or not only_displacement):
            data = "readings" if has_readings else "records of velocity or specific force"
            problems.add(
                ("study", "analyses", name, "method"),
                "the two-stage method requires records of displacement on a double turntable; "
                f"this campaign has {data}, which require the joint method",
                "method-not-applicable",
            )
            continue
        analysis = _parse_analysis(name, table, document, source, problems)
        if analysis is not None:
            analyses.append(analysis)
    if problems.lines:
        raise campaign_error(file, problems.lines)
    varying += _prior_quantities(campaign, varying)
    return StudyDescription(
        campaign, settings.trials, settings.seed, tuple(varying), tuple(analyses)
    )


def _prior_quantities(
    campaign: Campaign, varying: Sequence[VariedQuantity]
) -> Iterator[VariedQuantity]:
    """Yield the nuisance parameters with their stated or default priors.

    Parameters that vary already or have a value in [truth] are left out.
    """
    assert campaign.simulation is not None
    truth = campaign.simulation.truth
    excluded = {(quantity.owner, quantity.symbol) for quantity in varying}
    excluded |= {
        (name, symbol)
        for name, coefficients in truth.coefficients.items()
        for symbol in coefficients
    }
    excluded |= {("", symbol) for symbol in truth.machine} | truth.inputs.keys()
    excluded |= {("", symbol) for run in truth.runs.values() for symbol in run.shared}
    stated = inputs_by_owner(campaign)
    model = make_unknowns(campaign)
    for parameter in (*model.unknowns, *model.considered):
        owner = parameter.owner if parameter.symbol in {**ACCELEROMETER_TERMS, **INPUTS} else ""
        if (
            parameter.is_of_interest
            or parameter.prior[1] == 0.0
            or (owner, parameter.symbol) in excluded
        ):
            continue
        excluded.add((owner, parameter.symbol))
        value, u = parameter.prior
        mean = stated[owner, parameter.symbol].value if parameter.symbol in INPUTS else value
        yield VariedQuantity(
            owner,
            parameter.symbol,
            "normal",
            mean,
            u,
            term(parameter.symbol).per_run,
            parameter.correlations,
        )


def _campaign_document(
    raw: dict[str, Any], file: Path, problems: Problems
) -> tuple[Mapping[str, Any], Path]:
    """Return the campaign's document and file: this one, or the one that a study's file names."""
    if not isinstance(raw.get("campaign"), str):
        return raw, file
    base = description_file(file.parent / raw["campaign"])
    known = ("schema", "campaign", "study")
    for key in raw:
        if key not in known:
            problems.add((key,), "unknown key" + suggest_name(key, known), "unknown-key")
    if type(raw.get("schema")) is not int or raw["schema"] != 1:
        problems.add(
            ("schema",), "this version of counterspin supports schema = 1", "unknown-choice"
        )
    return load_document(base, CAMPAIGN_ADVICE, "campaign"), base


def _campaign(
    document: Mapping[str, Any], file: Path, problems: Problems, prefix: KeyPath
) -> Campaign | None:
    """Return the campaign of a document, or None with its mistakes noted."""
    nested = Problems(document)
    campaign = resolve_campaign(document, file, nested)
    start = f"{prefix[0]}: " if prefix else ""
    problems.lines += [start + line for line in nested.lines if line not in problems.lines]
    return campaign


def _is_same_quantity(first: VariedQuantity, second: VariedQuantity) -> bool:
    ripples = {"spindle.ripple.ratio", "spindle.ripple.amplitude"}
    if {first.symbol, second.symbol} == ripples:
        return True
    return (first.owner, first.symbol) == (second.owner, second.symbol)


def _walk_entries(
    table: Mapping[str, Any], path: KeyPath, prefix: str = ""
) -> Iterator[tuple[str, KeyPath, Any]]:
    """Yield name, path and entry; names may be written with quotation marks or without."""
    for key, value in table.items():
        nested = isinstance(value, Mapping) and not any(name in value for name in _DISTRIBUTIONS)
        if nested and value and all(isinstance(entry, Mapping) for entry in value.values()):
            yield from _walk_entries(value, (*path, key), f"{prefix}{key}.")
        else:
            yield prefix + key, (*path, key), value


def _varied_quantities(
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
    unit = OTHER_QUANTITIES.get(symbol) or unit_of(symbol)
    parameters = problems.collect(
        path,
        _parse_distribution,
        distribution,
        getattr(settings, distribution),
        unit,
        campaign.gravity.value,
    )
    per_run = settings.per == "run"
    if per_run and (symbol in (*INPUTS, *NOISE_LEVELS) or not campaign.runs):
        problems.add(
            path,
            "this quantity is the same in all runs and readings of a campaign; remove the key per",
        )
    if parameters is None:
        return []
    first, second = parameters
    if symbol == WHITE and first <= 0.0:
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
    if symbol in NOISE_LEVELS and first < 0.0:
        problems.add(path, "must not be less than zero", "value-out-of-range")
    return [
        VariedQuantity(owner, name, distribution, first, second, per_run)  # type: ignore[arg-type]
        for owner, name in names
    ]


def _resolve_names(
    key: str,
    path: KeyPath,
    campaign: Campaign,
    recorders: Mapping[str, str],
    problems: Problems,
) -> list[tuple[str, str]]:
    """Return owner and symbol of everything that a name stands for."""
    owner, _, symbol_name = key.partition(".")
    if owner in campaign.accelerometers and symbol_name in ACCELEROMETER_TERMS:
        return [(owner, symbol_name)]
    if key in ACCELEROMETER_TERMS:
        return [(name, key) for name in campaign.accelerometers]
    observable_symbols = shown_symbols(campaign.readings)
    if key in INPUTS or symbol_name in INPUTS:
        return _resolve_inputs(key, path, campaign, recorders, problems)
    if key in OTHER_QUANTITIES and not campaign.runs:
        problems.add(
            path, "this quantity requires double-turntable records, but the campaign contains none"
        )
    shared = (key,) if key in SHARED_TERMS or key in OTHER_QUANTITIES else ()
    if symbols := shared or expand_name(key, observable_symbols):
        return [("", symbol) for symbol in symbols]
    if key in BARE_NAMES:
        mountings = [a.mounting for a in campaign.accelerometers.values()]
        rows = acting_rows(key, mountings, [run.attitude for run in campaign.runs])
        return [("", row.symbol) for row in rows]
    candidates = [
        *OTHER_QUANTITIES,
        *ACCELEROMETER_TERMS,
        *BARE_NAMES,
        *SHARED_TERMS,
        *observable_symbols,
    ]
    hint = suggest_name(key, candidates)
    if "known:" in hint:
        hint = f"; known: {', '.join([*OTHER_QUANTITIES, *ACCELEROMETER_TERMS, *BARE_NAMES])}"
    problems.add(path, "cannot be varied in a study" + hint, "unknown-term")
    return []


def _resolve_inputs(
    key: str, path: KeyPath, campaign: Campaign, recorders: Mapping[str, str], problems: Problems
) -> list[tuple[str, str]]:
    """Return owner and symbol of an input; without an owner's name those of all owners."""
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
    """Return the two numbers of a distribution."""
    if distribution == "normal":
        quantity = parse_quantity(_as_quantity(value, unit), unit, gravity=gravity)
        if quantity.u <= 0.0:
            raise ValueError('write a normal distribution as "MEAN ± SD UNIT"')
        return quantity.value, quantity.u
    if distribution == "fixed":
        return parse_exact(_as_quantity(value, unit), unit, gravity), 0.0
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError('write a uniform distribution as ["LOWEST UNIT", "HIGHEST UNIT"]')
    low, high = (parse_exact(_as_quantity(bound, unit), unit, gravity) for bound in value)
    if not low < high:
        raise OutOfRangeError("the lowest value must be below the highest")
    return low, high


def _as_quantity(value: Any, unit: str) -> Any:
    """Write a plain number where a ratio is wanted as a quantity."""
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
    error_count = len(problems.lines)
    campaign = _campaign(_apply_terms(document, settings), file, problems, (".".join(path),))
    if campaign is None or len(problems.lines) > error_count:
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
    """Return the campaign's document with the terms of one analysis."""
    model = dict(document.get("model", {}))
    if not (settings.terms is settings.hold is settings.considered is None):
        # What was held is so no longer: it may be among the terms.
        model = {k: v for k, v in model.items() if k not in ("hold", "considered")}
    for key in ("terms", "assume", "hold", "considered"):
        if (names := getattr(settings, key)) is not None:
            model[key] = names
    return {**document, "model": model} if model else dict(document)
