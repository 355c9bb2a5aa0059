"""The dossier: all cases pass, deviating kernels are named, and the files agree."""

import json
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader

import counterspin as cs
from certificates import SCHEMA, needs_schema
from counterspin.cli import main
from counterspin.physics.terms import TERMS
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.validation import validate as validating
from counterspin.validation.cases import case, cases
from counterspin.validation.validate import DOSSIER_FILES, check_case, validate

#: Functions that return a verdict or a document, tested separately.
CHECKS = (
    "counterspin.certificates.schema:check_schema",
    "counterspin.certificates.signature:verify",
)
CERTIFICATE = "counterspin.certificates.issuing:certificate"
KERNELS = sorted({actual_case.kernel for actual_case in cases()} - {*CHECKS, CERTIFICATE})
SCHEMA_CASE = "certificate against the DCC schema"
REQUIREMENTS = {
    "physics",
    "spindle",
    "least squares",
    "joint fit",
    "readings",
    "correction",
    "units",
    "priors and considered terms",
    "noise",
    "intervals and coverage",
    "conformity",
    "planning",
    "certificate",
    "reading of each file format",
}


@pytest.fixture(scope="module")
def dossier():
    return validate()


@pytest.mark.slow
def test_all_cases_pass(dossier):
    assert len(dossier.cases) >= 40
    # The DCC schema is not part of the package.
    assert [case.name for case in dossier.cases if case.state != "passed"] == [SCHEMA_CASE]
    assert any("name its folder (`schema`)" in text for text in dossier.not_covered)
    assert dossier.passed
    run = [case for case in dossier.cases if case.name != SCHEMA_CASE]
    assert all(
        finished_case.numbers > 0 and finished_case.source and finished_case.limit is not None
        for finished_case in run
    )


@pytest.mark.parametrize("kernel", [pytest.param(CHECKS[0], marks=needs_schema), CHECKS[1]])
def test_check_that_always_or_never_passes_is_named(kernel, monkeypatch):
    chosen = [case for case in cases() if case.kernel == kernel]
    assert [case.state for case in validate(schema=schema(), chosen=chosen).cases] == ["passed"]
    module, _, name = kernel.partition(":")
    for wrong in (lambda *_: None, raise_record_error):
        monkeypatch.setattr(import_module(module), name, wrong)
        assert validate(schema=schema(), chosen=chosen).failed == [chosen[0].name]


@pytest.mark.parametrize("of", ["certificate_text.expanded_uncertainty", "build.region_factor"])
def test_wrong_coverage_factor_fails_case(of, monkeypatch):
    module, name = of.split(".")
    owner = import_module(f"counterspin.certificates.{module}")
    original = getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *given: 1.001 * original(*given))
    chosen = [case for case in cases() if case.kernel == CERTIFICATE]
    assert validate(chosen=chosen).failed == [chosen_case.name for chosen_case in chosen]


def test_tolerances_of_fits_are_small_relative_to_u():
    """Tolerances are at most 0.5 % of u, and 0.0003 u for a stated noise."""
    fits = [case for case in cases() if case.absolute_tolerance is None]
    assert len(fits) >= 6
    for fit_case in fits:
        for name, line in fit_case.expected.items():
            if line.size == 5:
                relative_tolerance = fit_case.tolerance(name) / line[1]
                assert np.all(
                    relative_tolerance <= (0.0051 if fit_case.requirement == "noise" else 0.00031)
                ), name


def schema():
    return SCHEMA if SCHEMA.exists() else None


def raise_record_error(*_):
    raise cs.RecordError("everything is refused")


def test_missing_schema_folder_raises_before_cases_run(tmp_path, capsys):
    arguments = ["validate", "-o", str(tmp_path / "d"), "--schema", str(tmp_path / "none")]
    assert main(arguments) == 1
    assert "file not found" in capsys.readouterr().err
    assert not (tmp_path / "d" / "validation.html").exists()


def test_all_requirements_and_formats_have_cases():
    assert {case.requirement for case in cases()} >= REQUIREMENTS
    record_files = [case.given["file"] for case in cases() if case.kernel.endswith(":read_record")]
    assert {f".{name.rpartition('.')[2]}" for name in record_files} == {*RECORD_FORMATS}
    names = [case.name for case in cases()]
    assert len(set(names)) == len(names)


def test_documented_number_of_cases_is_current():
    changelog = (Path(__file__).parents[2] / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"{len(cases())} reference cases" in changelog


def perturb(value):  # noqa: PLR0911 -- a branch for each kind of value
    """Return a kernel's value with all numbers changed by 1e-6 of themselves."""
    if isinstance(value, bool | str | int | None):
        return value
    if isinstance(value, float | np.floating):
        return value * (1.0 + 1e-6)
    if isinstance(value, np.ndarray):
        return value * (1.0 + 1e-6) if value.dtype.kind == "f" else value
    if isinstance(value, dict):
        return {key: perturb(item) for key, item in value.items()}
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(perturb, value))
    if hasattr(value, "model_copy"):
        changed = {key: perturb(getattr(value, key)) for key in type(value).model_fields}
        return value.model_copy(update=changed)
    if is_dataclass(value) or hasattr(value, "__dataclass_fields__"):
        return replace(
            value,
            **{
                field.name: perturb(getattr(value, field.name))
                for field in fields(value)
                if field.init
            },
        )
    return value


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.rpartition(":")[2])
def test_relative_kernel_error_of_1e_6_fails_case(kernel, monkeypatch):
    module, _, name = kernel.partition(":")
    owner = import_module(module)
    *owner_names, function_name = name.split(".")
    for owner_name in owner_names:
        owner = getattr(owner, owner_name)
    original = getattr(owner, function_name)
    monkeypatch.setattr(
        owner, function_name, lambda *given, **more: perturb(original(*given, **more))
    )
    states = {case.name: check_case(case).state for case in cases() if case.kernel == kernel}
    assert "failed" in states.values(), states


def test_term_without_integrals_fails_only_its_cases(monkeypatch):
    """A missing expected value does not affect other cases."""
    k_4 = TERMS["K_4"]
    new_term = replace(k_4, symbol="K_NEW", effect=replace(k_4.effect, factors=6 * ("I",)))
    monkeypatch.setattr("counterspin.validation.cases.TERMS", {**TERMS, "K_NEW": new_term})
    cases.cache_clear()
    column_cases = [case for case in cases() if case.kernel.endswith(":columns")][:1]
    dossier = validate(chosen=[*column_cases, case("normal quantile")])
    assert [case.state for case in dossier.cases] == ["failed", "passed"]
    assert "double_integrals.json does not contain the integral of K_NEW" in dossier.cases[0].note


def test_command_fails_with_name_of_case(tmp_path, monkeypatch, capsys):
    from counterspin.inference import distributions

    chosen_cases = [case("normal quantile"), case("weighted mean"), case("NIST Norris")]
    monkeypatch.setattr(validating, "cases", lambda: chosen_cases)
    normal_quantile = distributions.normal_quantile
    monkeypatch.setattr(
        distributions, "normal_quantile", lambda p: normal_quantile(p) * (1.0 + 1e-6)
    )
    assert main(["validate", "-o", str(tmp_path / "dossier")]) == 1
    assert "reference cases failed: normal quantile" in capsys.readouterr().err
    dossier = cs.Dossier.read(tmp_path / "dossier" / "validation.json")
    assert dossier.failed == ["normal quantile"]
    (failed_case,) = (case for case in dossier.cases if case.state == "failed")
    assert failed_case.digits == pytest.approx(6.0, abs=1e-3)


def test_kernel_exception_fails_case(monkeypatch):
    from counterspin.inference import least_squares

    monkeypatch.setattr(least_squares, "fit", lambda *_: 1 / 0)
    checked = check_case(case("GUM H.3"))
    assert checked.state == "failed"
    assert "ZeroDivisionError" in checked.note


def test_format_without_package_is_not_covered(monkeypatch):
    from counterspin.validation import files

    monkeypatch.setattr(files, "find_spec", lambda name: None)
    dossier = validate(chosen=[case("record as TDMS (.tdms)")])
    assert [checked_case.state for checked_case in dossier.cases] == ["not run"]
    assert any("nptdms is not installed" in text for text in dossier.not_covered)


def test_three_files_agree(dossier, tmp_path):
    cs.write_dossier(dossier, tmp_path / "d")
    assert {path.name for path in (tmp_path / "d").iterdir()} == {*DOSSIER_FILES}
    page = (tmp_path / "d" / "validation.html").read_text(encoding="utf-8")
    paper = PdfReader(tmp_path / "d" / "validation.pdf")
    text = " ".join(" ".join(sheet.extract_text().split()) for sheet in paper.pages)
    document = json.loads((tmp_path / "d" / "validation.json").read_text(encoding="utf-8"))
    assert len(document["cases"]) == len(cases())
    count = len(cases())
    answer = f"{count - 1} of {count} reference cases passed, 1 could not be run; none failed."
    for report_text in (page, text):
        assert answer in report_text
        assert "Limits of the validation" in report_text
        assert "NIST Norris" in report_text
    with pytest.raises(cs.CounterspinError, match="exists"):
        cs.write_dossier(dossier, tmp_path / "d")
    cs.write_dossier(dossier, tmp_path / "d", overwrite=True)
