"""A certificate contains the numbers of the result in SI and only stated data."""

import re
from base64 import b64decode

import numpy as np
import pytest
from prose import ROOT
from raising import raises
from results import make_coefficient, make_qx_result, make_two_accelerometers

from certificates import ISSUE, LAB, find_elements, make_document
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates.build import SCHEMA_VERSION, check_certifiable
from counterspin.certificates.certificate_reader import read_certificate
from counterspin.certificates.certificate_text import coverage_factor, region_factor
from counterspin.certificates.schema import NAMESPACES, clean_text, format_decimal, format_exact
from counterspin.certificates.statements import Issue
from counterspin.errors import RecordError
from counterspin.inference.verdicts import Conformity
from counterspin.physics.terms import PLATFORM_TERMS, TERMS
from counterspin.units import from_si, si_unit, to_si, unit_factor

G = 9.80665
QUANTITY = "//dcc:measurementResult//dcc:quantity[@refType='basic_measuredValue']"


# Units


def test_units_in_d_si_notation():
    assert si_unit("g")[0].dsi_text == r"\metre\second\tothe{-2}"
    assert si_unit("g/g")[0].dsi_text == r"\one"
    assert si_unit("g/g^2")[0].dsi_text == r"\metre\tothe{-1}\second\tothe{2}"
    assert si_unit("g/g^3")[0].dsi_text == r"\metre\tothe{-2}\second\tothe{4}"
    assert si_unit("rad/s/g")[0].dsi_text == r"\radian\metre\tothe{-1}\second"
    with pytest.raises(ValueError, match="furlong"):
        si_unit("furlong")


def test_documentation_states_schema_version():
    page = (ROOT / "docs" / "certificate.md").read_text("utf-8")
    assert re.findall(r"DCC (\d[\d.]*\d)", page) == [SCHEMA_VERSION]


def test_documentation_lists_units_of_all_terms():
    row = re.compile(r"^\| ([KKd]\w+).*? \| ([^|]+) \| (.*) \| `(.*)` \|$", re.MULTILINE)
    rows = row.findall((ROOT / "docs" / "certificate.md").read_text("utf-8"))
    assert {unit for _, unit, *_ in rows} == {term.unit for term in TERMS.values()}
    for symbol, unit, displayed_unit, dsi_unit in rows:
        assert TERMS[symbol].unit == unit
        assert si_unit(unit)[0].dsi_text == dsi_unit
        parts = re.findall(r"\\(metre|second|radian|one)(?:\\tothe\{(-?\d)\})?", dsi_unit)
        letters = {"metre": "m", "second": "s", "radian": "rad", "one": "1"}
        assert (
            " ".join(letters[name] + (f"^{n}" if n else "") for name, n in parts) == displayed_unit
        )


@pytest.mark.parametrize("unit", sorted({row.unit for row in [*TERMS.values()]}))
def test_error_model_is_equivalent_in_si(unit):
    # g (sum of K (a/g)^n) = sum of K' a^n, with the products of the table.
    force = np.array([[-23.0], [4.0], [11.0]])  # m/s^2
    for row in TERMS.values():
        if row.unit == unit:
            in_g = G * 0.7 * row.effect.evaluate(force / G)
            in_si = to_si(0.7, unit, G) * row.effect.evaluate(force)
            scale = G if unit == "rad" else 1.0  # an angle is not converted with g
            assert in_si * scale == pytest.approx(in_g * scale, rel=1e-14)


@pytest.mark.parametrize(
    "unit", sorted({row.unit for row in [*TERMS.values(), *PLATFORM_TERMS.values()]})
)
def test_conversion_agrees_with_quantities_and_is_invertible(unit):
    plain_unit = si_unit(unit)[0].plain_text
    assert to_si(3.0, unit, G) == pytest.approx(
        3.0 * unit_factor(unit, plain_unit, gravity=G), rel=1e-15
    )
    assert from_si(to_si(3.0, unit, G), unit, G) == pytest.approx(3.0, rel=1e-15)


# Coverage


def test_coverage_factors_match_tables():
    # Student's t: GUM table G.2; chi-square and F at 95 %: NIST handbook 1.3.6.7.
    assert coverage_factor(None) == 1.96
    assert coverage_factor(1) == pytest.approx(12.71, abs=0.005)
    assert coverage_factor(10) == pytest.approx(2.23, abs=0.005)
    assert region_factor(1, None) == coverage_factor(None)
    assert region_factor(2, None) ** 2 == pytest.approx(5.991, abs=0.0005)
    assert region_factor(3, None) ** 2 == pytest.approx(7.815, abs=0.0005)
    assert region_factor(3, 10.0) ** 2 / 3 == pytest.approx(3.708, abs=0.0005)
    assert region_factor(1, 10.0) == coverage_factor(10)


def test_numbers_match_schema_format():
    assert format_decimal(12.7062) == "12.7062"
    assert format_decimal(0.95) == "0.95"
    assert format_decimal(2.0) == "2"
    assert float(format_exact(0.1 + 0.2)) == 0.1 + 0.2


# The numbers of a certificate


def test_output_units_known_to_si_are_certified(tmp_path):
    calibration = make_qx_result()
    accelerometer = calibration.accelerometers["Qx"]
    output = {
        "bias": Coefficient(**make_coefficient(6.25, 1e-3, "mA")),
        "scale_factor": Coefficient(**make_coefficient(1.25, 1e-6, "mA/g")),
    }
    coefficients = accelerometer.coefficients | {
        symbol: Coefficient(**make_coefficient(1.0, 1e-6, TERMS[symbol].unit))
        for symbol in ("K_F", "K_I")
    }
    accelerometer = accelerometer.model_copy(update={"coefficients": coefficients})
    calibration = calibration.model_copy(update={"accelerometers": {"Qx": accelerometer}})
    accelerometer_with_output = accelerometer.model_copy(update={"output": output})
    xml = make_document(
        tmp_path,
        calibration.model_copy(update={"accelerometers": {"Qx": accelerometer_with_output}}),
    )
    values = {"Bias": (6.25e-3, r"\ampere"), "Scale factor": (1.25e-3 / 9.8, "")}
    for name, (value, unit) in values.items():
        real = f"{QUANTITY}[dcc:name/dcc:content='{name}']/si:real"
        assert float(find_elements(xml, f"{real}/si:value")[0].text) == pytest.approx(
            value, rel=1e-15
        )
        assert unit in find_elements(xml, f"{real}/si:unit")[0].text
    assert list(read_certificate(xml, "c").accelerometers["Qx"].coefficients) == list(
        read_certificate(make_document(tmp_path, calibration), "c")
        .accelerometers["Qx"]
        .coefficients
    )
    accelerometer_with_unknown_unit = accelerometer_with_output.model_copy(
        update={"output": {"bias": Coefficient(**make_coefficient(6.25, 1e-3, "V/Hz^0.5"))}}
    )
    xml = make_document(
        tmp_path,
        calibration.model_copy(update={"accelerometers": {"Qx": accelerometer_with_unknown_unit}}),
    )
    assert not find_elements(xml, f"{QUANTITY}[dcc:name/dcc:content='Bias']")
    assert b"In the unit of the readings, the bias" in xml


def test_coefficient_in_si(tmp_path):
    xml = make_document(tmp_path, make_qx_result())
    real = f"{QUANTITY}[dcc:name/dcc:content='K_II']/si:real"
    assert float(find_elements(xml, f"{real}/si:value")[0].text) == pytest.approx(
        2.7e-5 / 9.8, rel=1e-15
    )
    assert find_elements(xml, f"{real}/si:unit")[0].text == r"\metre\tothe{-1}\second\tothe{2}"
    mu = f"{real}/si:measurementUncertaintyUnivariate/si:expandedMU"
    k = float(find_elements(xml, f"{mu}/si:coverageFactor")[0].text)
    assert k == pytest.approx(2.0086, abs=1e-4)  # t for 50 degrees of freedom
    expanded = float(find_elements(xml, f"{mu}/si:valueExpandedMU")[0].text)
    assert expanded == pytest.approx(k * 1e-9 / 9.8, rel=1e-15)
    assert find_elements(xml, f"{mu}/si:coverageProbability")[0].text == "0.95"
    assert find_elements(xml, f"{mu}/si:distribution")[0].text == "t"
    # u is 1.02e-10 s^2/m: its second digit is 1e-11.
    assert find_elements(xml, f"{real}/si:significantDigit")[0].text == "-11"
    description = find_elements(
        xml, f"{QUANTITY}[dcc:name/dcc:content='K_II']/dcc:description/dcc:content"
    )[0]
    assert "27.0000 ± 0.0020 ug/g^2 (U, k = 2.0086)" in description.text
    gravity = find_elements(xml, "//dcc:statement/dcc:nonSIDefinition")[0].text
    assert gravity == "1 g = 9.8 m/s^2, the local gravity at the site"


def test_certificate_round_trip(tmp_path):
    calibration = make_qx_result(
        coefficients={
            "K_F": make_coefficient(0.005028816, 1.2e-9, "g"),
            "K_I": make_coefficient(1.0019743, 4.9e-6, "g/g", dof=7.25),
            "K_II": make_coefficient(-2.70416e-5, 7.21e-10, "g/g^2", dof=50.0),
            "K_III": make_coefficient(3.4e-6, 1.05e-6, "g/g^3"),
            "delta_O": make_coefficient(1e-4, 3e-6, "rad"),
        },
        correlation={
            "terms": ["K_I", "K_II", "K_III", "K_F", "delta_O"],
            "matrix": [
                [1.0000000000000002, 0.5, -0.25, 0.1, 0.0],
                [0.5, 1.0, -0.999, 0.3, 0.01],
                [-0.25, -0.999, 1.0, 0.2, 0.02],
                [0.1, 0.3, 0.2, 1.0, 0.03],
                [0.0, 0.01, 0.02, 0.03, 1.0],
            ],
        },
    )
    numbers = read_certificate(make_document(tmp_path, calibration), "x.xml")
    assert (numbers.identifier, numbers.gravity) == ("CS-42", 9.8)
    original, certified = calibration.accelerometers["Qx"], numbers.accelerometers["Qx"]
    assert list(certified.coefficients) == list(original.coefficients)
    for symbol, certified_coefficient in certified.coefficients.items():
        # A product and a quotient, each rounded by half of 2^-52.
        assert certified_coefficient.value == pytest.approx(
            original.coefficients[symbol].value, rel=1e-15
        )
        assert certified_coefficient.u == pytest.approx(original.coefficients[symbol].u, rel=1e-15)
        assert (certified_coefficient.dof, certified_coefficient.unit) == (
            original.coefficients[symbol].dof,
            original.coefficients[symbol].unit,
        )
    assert list(certified.terms) == original.correlation.terms
    u = np.array([original.coefficients[symbol].u for symbol in certified.terms])
    expected = np.array(original.correlation.matrix) * np.outer(u, u)
    assert certified.covariance == pytest.approx(expected, rel=2e-15)
    assert np.diag(certified.covariance) == pytest.approx(u**2, rel=1e-15)


def test_region_factor_uses_fewest_degrees_of_freedom(tmp_path):
    calibration = make_qx_result(
        coefficients={
            "K_F": make_coefficient(0.005, 1e-6, "g", dof=200.0),
            "K_I": make_coefficient(1.0, 1e-6, "g/g"),
            "K_II": make_coefficient(2.7e-5, 1e-9, "g/g^2", dof=50.0),
        }
    )
    xml = make_document(tmp_path, calibration)  # K_F and K_II are correlated
    region = "//si:ellipsoidalRegionMUXMLList"
    k = float(find_elements(xml, f"{region}/si:coverageFactorXMLList")[0].text)
    assert k == region_factor(2, 50.0)
    units = [element.text for element in find_elements(xml, f"{region}//si:unitXMLList")]
    assert units[0] == r"\metre\tothe{2}\second\tothe{-4}"
    assert units[1] == units[2] == r"\one"
    assert units[3] == r"\metre\tothe{-2}\second\tothe{4}"


def test_undetermined_coefficient_is_omitted_with_statement(tmp_path):
    calibration = make_qx_result(
        coefficients={
            "K_II": make_coefficient(2.7e-5, 1e-9, "g/g^2"),
            "K_I": {"value": 1.002, "u": 5e-6, "unit": "g/g", "estimated": False},
            "K_III": {"value": None, "u": None, "unit": "g/g^3", "estimated": False},
        },
        correlation={"terms": ["K_II"], "matrix": [[1.0]]},
    )
    xml = make_document(tmp_path, calibration)
    assert [element.text for element in find_elements(xml, f"{QUANTITY}/dcc:name/dcc:content")] == [
        "K_II"
    ]
    statements = find_elements(xml, "//dcc:statement/dcc:declaration/dcc:content")
    lines = [line for element in statements for line in element.text.splitlines()]
    assert "K_III of Qx is not certified: the records do not determine this coefficient." in lines
    (k_i_line,) = [line for line in lines if line.startswith("K_I of Qx")]
    assert "used the prior 1.0020000 ± 0.0000098 g/g (U, k = 1.96)" in k_i_line
    assert not find_elements(xml, "//si:realListXMLList")  # one coefficient has no covariance


def test_prior_information_is_stated(tmp_path):
    confounded_terms = {"terms": ["K_II", "K_OO"], "correlation": -1.0, "determined": "K_II + K_OO"}
    unstated = {"source": "K_OO", "kind": "unstated", "unit": "g/g^2", "u": 2e-6}
    small_line = {**unstated, "source": "K_PP", "sensitivity": 1e-5, "contribution": 2e-11}
    calibration = make_qx_result(
        confounded=[{**confounded_terms, "value": 2.7e-5, "u": 1e-9}],
        budget={
            "K_II": [
                {**unstated, "sensitivity": -3e-4, "contribution": 6e-10, "share": 0.36},
                {**small_line, "share": 4e-4},
            ]
        },
    )
    (statement,) = find_elements(
        make_document(tmp_path, calibration),
        "//dcc:statement[starts-with(dcc:name/dcc:content, 'Basis of the result')]",
    )
    assert statement.get("refId") == "item-1"
    path = "dcc:declaration/dcc:content"
    (content,) = statement.xpath(path, namespaces=NAMESPACES)
    confounded_sentence, default_sentence = content.text.splitlines()
    # ± precedes U alone.
    assert confounded_sentence.endswith(
        "the records determine only K_II + K_OO = 27.0000, u = 0.0010 ug/g^2."
    )
    assert default_sentence == (
        "Default prior: K_OO (second-order output-axis coefficient), standard uncertainty "
        "2.0 ug/g^2 (a third of K_IP in the paper's Table 1 (6e-6 g/g²); same value for the "
        "other terms); contribution to the variance at most 36 %."
    )


def test_rejects_as_printed_and_undetermined_results():
    with pytest.raises(RecordError, match="half the true K_II"):
        check_certifiable(make_qx_result().model_copy(update={"model": "as-printed"}), ["Qx"])
    undetermined = {"value": None, "u": None, "unit": "g/g^2", "estimated": False}
    with raises("not-determined", "Qx"):
        check_certifiable(make_qx_result(coefficients={"K_II": undetermined}), ["Qx"])
    for dof in (0.0, 0.1):
        without_interval = make_coefficient(2e-5, 1e-9, "g/g^2", dof=dof)
        with raises("not-determined", "Qx.K_II has less than one degree of freedom"):
            check_certifiable(make_qx_result(coefficients={"K_II": without_interval}), ["Qx"])
    check_certifiable(make_qx_result(), ["Qx"])


# Further content


def test_administrative_data_of_laboratory(tmp_path):
    xml = make_document(tmp_path, make_qx_result())
    core = "//dcc:coreData"
    assert [element.text for element in find_elements(xml, f"{core}/dcc:usedLangCodeISO639_1")] == [
        "en",
        "de",
    ]
    assert find_elements(xml, f"{core}/dcc:countryCodeISO3166_1")[0].text == "DE"
    assert find_elements(xml, f"{core}/dcc:endPerformanceDate")[0].text == "2026-01-14"
    assert find_elements(xml, f"{core}/dcc:issueDate")[0].text == "2026-01-20"
    content = find_elements(xml, "//dcc:items/dcc:item/dcc:name/dcc:content")[0]
    # By PTB's rules a text in one of two languages has no language attribute.
    assert (content.text, content.get("lang")) == ("Plattform", None)
    serial = "//dcc:subItems//dcc:identification[@refType='basic_serialNumber']/dcc:value"
    assert find_elements(xml, serial)[0].text == "Q-104"  # as the result has it
    signs = [element.text for element in find_elements(xml, "//dcc:respPerson/dcc:mainSigner")]
    assert signs == ["true", "false"]
    temperature = find_elements(
        xml, "//dcc:influenceCondition[@refType='basic_temperature']//si:real"
    )[0]
    assert [element.text for element in temperature[:2]] == ["20.5", r"\degreecelsius"]


def test_conditions_have_expanded_uncertainty(tmp_path):
    calibration = make_qx_result()
    inputs = calibration.inputs.model_copy(update={"u_gravity": 3e-6, "u_radius": 0.0})
    xml = make_document(tmp_path, calibration.model_copy(update={"inputs": inputs}))
    condition = "//dcc:influenceCondition[dcc:name/dcc:content='{}']//si:real"
    (value,) = find_elements(xml, condition.format("Local gravity") + "/si:value")
    (expanded,) = find_elements(xml, condition.format("Local gravity") + "//si:valueExpandedMU")
    assert float(expanded.text) == pytest.approx(2.0 * 3e-6, rel=0.02)  # k = 2, two digits
    assert float(value.text) == pytest.approx(inputs.gravity, abs=1e-7)
    assert not find_elements(
        xml, condition.format("Radius of the centrifuge") + "//si:valueExpandedMU"
    )


def test_slash_in_identifier_is_replaced_in_file_name(tmp_path):
    xml = make_document(tmp_path, make_qx_result(), issue=Issue("2026/1 a", ISSUE.date))
    assert find_elements(xml, "//dcc:uniqueIdentifier")[0].text == "2026/1 a"
    assert find_elements(xml, "/*/dcc:document/dcc:fileName")[0].text == "2026_1_a.pdf"


def test_unstated_conditions_are_omitted(tmp_path):
    text = """schema = 1
certificate = { begin = 2026-01-12, end = 2026-01-12, traceability = "To the SI." }
laboratory = { name = "L", city = "C", country = "DE" }
customer = { name = "K", city = "C" }
item = { name = "I", manufacturer = "M", model = "1", serial_number = "2" }
persons = [{ name = "P", role = "R" }]
"""
    xml = make_document(tmp_path, make_qx_result(), text=text)
    names = [
        element.text
        for element in find_elements(xml, "//dcc:influenceCondition/dcc:name/dcc:content")
    ]
    assert names == [
        "Local gravity",
        "Geographic latitude",
        "Radius of the centrifuge",
        "Rotation rate of each run",
        "Platform parameters, estimated together with the coefficients",
    ]


def test_result_and_report_are_attached(tmp_path):
    calibration = make_qx_result()
    xml = make_document(tmp_path, calibration, pages=b"%PDF-1.7 for people")
    (data,) = find_elements(xml, "//dcc:measurementMetaData//dcc:byteData/dcc:dataBase64")
    (tmp_path / "r.json").write_bytes(b64decode(data.text))
    assert Result.read(tmp_path / "r.json") == calibration
    (data,) = find_elements(xml, "/dcc:digitalCalibrationCertificate/dcc:document/dcc:dataBase64")
    assert b64decode(data.text) == b"%PDF-1.7 for people"


def test_warnings_are_included_with_control_characters_escaped(tmp_path):
    calibration = make_qx_result(warnings=["Qx: does not fit\x00\nK_II = 1\u202e & more"])
    calibration = calibration.model_copy(update={"warnings": ["of the campaign"]})
    xml = make_document(tmp_path, calibration)
    (comment,) = find_elements(xml, "/*/dcc:comment/dcc:content")
    assert comment.text.splitlines() == [
        "Warning: of the campaign",
        r"Warning: Qx: does not fit\x00\nK_II = 1\u202e & more",
    ]
    assert clean_text("\x0bab\ud800 ") == r"\x0bab\ud800"


@pytest.mark.parametrize(
    ("rule", "verdict", "high", "word"),
    [
        ("simple", "pass", 5e-5, ["pass"]),
        ("guarded", "fail", 1e-5, ["fail"]),
        ("guarded", "undecided", 2.7001e-5, ["conditionalPass"]),
        ("guarded", "undecided", 2.6999e-5, ["conditionalFail"]),
        ("probability", "undecided", 2.7e-5, []),
    ],
)
def test_conformity_uses_schema_terms(tmp_path, rule, verdict, high, word):
    judged = Conformity(
        specification=f"<= {high} g/g^2",
        low=None,
        high=high,
        unit="g/g^2",
        rule=rule,
        guard_band=2e-9 if rule == "guarded" else 0.0,
        needed=0.95 if rule == "probability" else None,
        verdict=verdict,
        probability=0.9,
        risk=None if verdict == "undecided" else 0.1,
    )
    xml = make_document(tmp_path, make_qx_result(), verdicts={"Qx": {"K_II": judged}})
    assert [
        element.text for element in find_elements(xml, "//dcc:statement/dcc:conformity")
    ] == word
    (statement,) = find_elements(xml, "//dcc:statement[dcc:norm='JCGM 106:2012']")
    assert find_elements(
        xml, f"//dcc:quantity[@id='{statement.get('refId')}']/dcc:name/dcc:content"
    )
    lines = " ".join(statement.itertext())
    plain_verdicts = {"conditionalPass": "conditional pass", "conditionalFail": "conditional fail"}
    verdict_texts = [plain_verdicts.get(keyword, keyword) for keyword in word] or [verdict]
    assert f"K_II of Qx, specified as <= {high} g/g^2: {verdict_texts[0]}." in lines
    assert "Probability of conformity: 90.0 %" in lines
    assert ("guard band 0.0020 ug/g^2" in lines) == (rule == "guarded")
    assert ("required probability 0.95" in lines) == (rule == "probability")


MORE = """
procedure = "AP-17, edition 3"
deviations = ["Two rates in place of three."]
customer_data = ["K_I, from the maker's data sheet"]
"""


def test_procedure_and_customer_data_are_stated(tmp_path):
    text = LAB.replace('language = "de"', MORE).replace('"0815"', '"0815"\nstate = "as received"')
    xml = make_document(tmp_path, make_qx_result(), text=text)
    method = "//dcc:measurementResult[1]/dcc:usedMethods/dcc:usedMethod[1]"
    assert [element.text for element in find_elements(xml, f"{method}/dcc:reference")] == [
        "AP-17, edition 3"
    ]
    assert not find_elements(xml, f"{method}/dcc:norm")  # the procedure deviates from IEEE Std 1293
    (described,) = find_elements(xml, f"{method}/dcc:description/dcc:content")
    assert described.text.startswith("The coefficients are based on the terms of IEEE Std 1293")
    assert described.text.endswith("Deviation: Two rates in place of three.")
    (state,) = find_elements(
        xml, "//dcc:influenceCondition[dcc:status='beforeAdjustment']/dcc:data"
    )
    assert "".join(state.itertext()).strip() == "The item was calibrated as received."
    (prior_line, supplied) = (
        find_elements(
            xml, f"//dcc:statement[dcc:name/dcc:content='{name}']/dcc:declaration/dcc:content"
        )
        for name in ("Prior information", "Data supplied by the customer")
    )
    assert prior_line[0].text == (
        "Prior for Qx: K_I (scale factor), standard uncertainty 5.0e-6 g/g, supplied by the "
        "customer."
    )
    assert "The laboratory is not responsible for these data" in supplied[0].text


def test_uncertainty_is_at_least_cmc(tmp_path):
    # K_II: U = 2.0086 nano-g/g^2 as evaluated; K_F: 1.96 ug.
    xml = make_document(
        tmp_path, make_qx_result(), text=LAB + '[cmc]\nK_II = "4 ng/g^2"\nK_F = "1 ug"\n'
    )
    accelerometer = read_certificate(xml, "x.xml").accelerometers["Qx"]
    k_ii, k_f = accelerometer.coefficients["K_II"], accelerometer.coefficients["K_F"]
    assert coverage_factor(50.0) * k_ii.u == pytest.approx(4e-9, rel=1e-14)
    assert k_ii.dof == 50.0
    assert k_f.u == pytest.approx(1e-6, rel=1e-14)
    # The added variance is independent of K_F: the covariance stays.
    assert accelerometer.covariance[0, 1] == pytest.approx(0.25 * 1e-6 * 1e-9, rel=1e-14)
    declarations = find_elements(
        xml, "//dcc:statement[dcc:norm='ILAC-P14:09/2020']/dcc:declaration/dcc:content"
    )
    assert declarations[0].text.startswith(
        "K_II of Qx: the evaluated uncertainty is U = 0.0020 ug/g^2. The certificate states"
    )
    assert "K_F" not in declarations[0].text
    # The attached result is unchanged.
    (data,) = find_elements(xml, "//dcc:measurementMetaData//dcc:byteData/dcc:dataBase64")
    attached = Result.model_validate_json(b64decode(data.text))
    assert attached.accelerometers["Qx"].coefficients["K_II"].u == 1e-9


def test_accelerometers_with_shared_inputs_are_correlated(tmp_path):
    terms = ["Qx.K_F", "platform.drift.north", "Qy.K_F", "Qy.K_II"]
    matrix = np.eye(4)
    matrix[0, 2] = matrix[2, 0] = 0.75
    xml = make_document(tmp_path, make_two_accelerometers(make_qx_result(), terms, matrix.tolist()))
    (joint_list,) = find_elements(
        xml, "//dcc:measurementResult[dcc:name/dcc:content='Joint results for all accelerometers']"
    )
    labels = joint_list.xpath(".//si:labelXMLList", namespaces=NAMESPACES)[0].text.split()
    assert labels == ["Qx.K_F", "Qy.K_F", "Qy.K_II"]
    values = joint_list.xpath(".//si:covarianceXMLList/si:valueXMLList", namespaces=NAMESPACES)
    covariance_matrix = np.array([float(value.text) for value in values]).reshape(3, 3)
    assert covariance_matrix[0, 1] == pytest.approx(0.75 * (9.8 * 1e-6) ** 2, rel=1e-14)
    assert covariance_matrix[0, 2] == 0.0
    assert list(read_certificate(xml, "x.xml").accelerometers) == ["Qx", "Qy"]


def test_rejects_document_that_is_not_a_certificate():
    with pytest.raises(RecordError, match=r"x\.xml is not XML"):
        read_certificate(b"no", "x.xml")
    with pytest.raises(RecordError, match="not a calibration certificate"):
        read_certificate(b"<a/>", "x.xml")


def test_rejects_coverage_factor_of_zero(tmp_path):
    xml = make_document(tmp_path, make_qx_result())
    invalid_xml = xml.replace(b"coverageFactor>1.96<", b"coverageFactor>0<")
    assert invalid_xml != xml
    with pytest.raises(RecordError, match="not a calibration certificate"):
        read_certificate(invalid_xml, "x.xml")
