"""How good the centrifuge must be."""

import tomllib

import pytest
from campaigns import replace_parts

from counterspin.campaign.description import read_campaign
from counterspin.ingest.starter import init
from counterspin.planning.faults import fault_sensitivities, path_fault
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import check, plan
from counterspin.reports.text import make_console
from counterspin.toml_text import format_document

SMALL = ('total_time = "700 s"', 'total_time = "240 s"')
FORCE = [
    SMALL,
    ('displacement = "0.01 m"', 'specific_force = "1e-4 g"'),
    ("bias = ", 'specific_force = { column = "f", unit = "m/s^2" }\nbias = '),
]


def test_requirements_increase_u_by_5_percent(write_starter, tmp_path):
    planned = plan(write_starter(SMALL))
    radius = next(line for line in planned.result.requirements if "radius" in line.words)
    document = tomllib.loads(planned.document)
    document["centrifuge"]["radius"] = f"2.5 ± {radius.size!r} m"
    document["truth"]["Qx"] = {"K_II": "1e-4 g/g^2"}
    (tmp_path / "campaign.toml").write_text(format_document(document), encoding="utf-8")
    after = forecast(read_campaign(tmp_path)).u["Qx.K_II"]
    before = planned.result.accelerometers["Qx"].coefficients["K_II"].u
    # As large as the requirement is stated for, and u^2 grows by 1.05^2.
    assert after / before == pytest.approx(1.05, rel=1e-3)


def test_eccentricity_and_imbalance_increase_u_by_5_percent(write_starter):
    planned = plan(write_starter(*FORCE))
    prediction = forecast(write_planned_campaign(planned, write_starter))
    place = [u.name for u in prediction.fit.model.unknowns].index("Qx.K_II")
    paths = ("encoder.harmonic.1", "centrifuge.imbalance.1")
    responses = fault_sensitivities(prediction, [path_fault(symbol) for symbol in paths])
    sizes = {line.words: line.size for line in planned.result.requirements}
    for response, words in zip(responses, ("encoder error", "imbalance"), strict=True):
        size = next(size for key, size in sizes.items() if words in key)
        added = response.unit_shift(place) * size / prediction.u["Qx.K_II"]
        assert 1.0 + added**2 == pytest.approx(1.05**2, rel=1e-9)
    # A second of arc would be far too much, where a force is recorded.
    assert responses[0].shift(place) > 10.0 * prediction.u["Qx.K_II"]


def test_requirement_of_estimated_fault_is_computed_without_it(write_starter, tmp_path):
    """The fit would absorb the fault, so it would seem to have no requirement."""
    document = tomllib.loads(plan(write_starter(*FORCE)).document)
    moved = []
    for known in ({}, {"encoder.harmonic.1": "0 ± 1 arcsec"}):
        document["model"]["priors"] |= known
        (tmp_path / "campaign.toml").write_text(format_document(document), encoding="utf-8")
        result = check(tmp_path)
        u = result.accelerometers["Qx"].coefficients["K_II"].u
        sizes = {line.words: line.size for line in result.requirements}
        moved += [u / next(size for words, size in sizes.items() if "encoder error" in words)]
    assert moved[1] == pytest.approx(moved[0], rel=1e-6)


def write_planned_campaign(planned, write_starter):
    """Write the campaign of a plan and read it back."""
    file = write_starter().parent / "campaign.toml"
    file.write_text(planned.document, encoding="utf-8")
    return read_campaign(file)


def test_impossible_sizes_have_no_requirement(tmp_path, capsys):
    file = init(tmp_path / "example")
    text = replace_parts(
        file.read_text(encoding="utf-8"), ("\n[model] ", '\n[model]\nassume = "all" #')
    )
    file.write_text(text, encoding="utf-8")
    result = check(file)
    sizes = {line.words: line.size for line in result.requirements}
    # Of 1.8e6 rad and 1.7e5 s these runs need to know nothing.
    assert sizes["zero of the angle, varying between runs"] is None
    assert sizes["delay between the clocks of angle and output"] is None
    assert all(size is None or size < 1.0 for size in sizes.values())
    console = make_console()
    console.width = 120
    console.print(result)
    printed = " ".join(capsys.readouterr().out.split())
    assert "zero of the angle, varying between runs no limit" in printed
    assert "delay between the clocks of angle and output no limit" in printed
