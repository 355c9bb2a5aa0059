"""Triad parameters in the certificate with U and covariance, in XML and on the pages."""

import numpy as np
import pytest

import counterspin as cs
import triads
from certificates import (
    ISSUE,
    LAB,
    SCHEMA,
    find_elements,
    make_document,
    needs_schema,
    read_lab_for,
)
from counterspin.calibration.result_parts import Correlation
from counterspin.certificates.amendment import describe_changes
from counterspin.certificates.certificate_reader import read_certificate
from counterspin.certificates.certificate_text import coverage_factor, region_factor
from counterspin.certificates.pdf_pages import page_blocks
from counterspin.certificates.schema import NAMESPACES, check_schema
from counterspin.certificates.statements import certificate_statements
from counterspin.cli import main
from counterspin.reports.blocks import Paragraph, Table
from counterspin.reports.numbers import find_display_unit, format_estimate

G = 9.81
OWN = LAB + '\n[evidence]\nall = "Type test 4714."\n'
PART = "//dcc:measurementResult[dcc:name/dcc:content='Triad X, Y, Z']/dcc:results/dcc:result"


def _indications(count, noise=3e-4):
    generator = np.random.default_rng(7)
    values = triads.compute_indications(triads.draw_directions(count, generator))
    return values + noise * generator.standard_normal(values.shape)


@pytest.fixture(scope="module")
def pose_result(tmp_path_factory):
    """Return the result of a triad in 25 poses with estimated noise."""
    return cs.calibrate(
        triads.write_pose_campaign(tmp_path_factory.mktemp("triad"), _indications(25))
    )


def _read_numbers(xml, path):
    (text,) = find_elements(xml, path)
    return np.array([float(word) for word in text.text.split()])


def _page_blocks(folder, result, text=OWN):
    lab = read_lab_for(folder, result, text)
    return list(page_blocks(lab, result, ISSUE, {}))


def test_parameters_are_in_si_with_covariance(tmp_path, pose_result):
    xml, triad = make_document(tmp_path, pose_result, text=OWN), pose_result.triad
    quantities = find_elements(xml, f"{PART}/dcc:data/dcc:quantity[@refType='basic_measuredValue']")
    scale = np.array([G, G, G, 1, 1, 1, 1, 1, 1])  # only offsets are accelerations
    units = [r"\metre\second\tothe{-2}"] * 3 + [r"\one"] * 3 + [r"\radian"] * 3
    assert len(quantities) == 9
    for quantity, (name, parameter), factor, unit in zip(
        quantities, triad.parameters.items(), scale, units, strict=True
    ):

        def find_text(path, within=quantity):
            return within.xpath(path, namespaces=NAMESPACES)[0].text

        assert find_text(".//si:label") == name
        assert find_text(".//si:unit") == unit
        assert float(find_text("si:real/si:value")) == pytest.approx(
            factor * parameter.value, rel=1e-14
        )
        k = float(find_text(".//si:coverageFactor"))
        assert k == coverage_factor(16.0) == pytest.approx(2.120, abs=5e-4)  # GUM, table G.2
        assert float(find_text(".//si:valueExpandedMU")) / k == pytest.approx(
            factor * parameter.u, rel=1e-14
        )
    u = scale * [parameter.u for parameter in triad.parameters.values()]
    covariance = [
        float(element.text)
        for element in find_elements(xml, f"{PART}//si:covarianceXMLList/si:valueXMLList")
    ]
    np.testing.assert_allclose(
        np.reshape(covariance, (9, 9)),
        np.array(triad.correlation.matrix) * np.outer(u, u),
        rtol=1e-12,
    )
    assert _read_numbers(
        xml, f"{PART}//si:coverageFactorXMLList[../si:covarianceMatrixXMLList]"
    ) == (pytest.approx(region_factor(9, 16.0), abs=1e-4))
    # Reading adds no accelerometer.
    assert set(read_certificate(xml, "x.xml").accelerometers) == {"X", "Y", "Z"}


def test_parameters_and_matrix_round_trip(tmp_path, pose_result):
    triad, certified_triad = (
        pose_result.triad,
        read_certificate(make_document(tmp_path, pose_result, text=OWN), "x").triad,
    )
    assert certified_triad.accelerometers == ("X", "Y", "Z")
    coefficients = certified_triad.parameters.coefficients
    assert list(coefficients) == list(triad.parameters)
    for name, parameter in triad.parameters.items():
        certified_parameter = coefficients[name]
        assert (certified_parameter.unit, certified_parameter.dof) == (
            parameter.unit,
            pytest.approx(16.0, abs=1e-3),
        )
        assert (certified_parameter.value, certified_parameter.u) == pytest.approx(
            (parameter.value, parameter.u), rel=1e-4
        )  # k has five digits
    u = [parameter.u for parameter in triad.parameters.values()]
    np.testing.assert_allclose(
        certified_triad.parameters.covariance,
        np.array(triad.correlation.matrix) * np.outer(u, u),
        rtol=1e-9,
    )
    np.testing.assert_allclose(certified_triad.matrix, triad.matrix, rtol=1e-15)
    np.testing.assert_allclose(
        certified_triad.expanded_matrix / certified_triad.coverage_factor, triad.u_matrix, rtol=1e-4
    )
    np.testing.assert_allclose(certified_triad.bias, triad.bias, rtol=1e-14)


def test_verify_prints_parameters_and_reports_changed_matrix(tmp_path, pose_result, capsys):
    xml = make_document(tmp_path, pose_result, text=OWN)
    file = tmp_path / "c.xml"
    file.write_bytes(xml)
    assert main(["certificate", "--verify", str(file)]) == 0
    output = capsys.readouterr().out
    for text in (
        "sensitivity of Z",
        "angle between Y and Z minus 90 deg",
        "M ± U",
        "calculated from these parameters",
    ):
        assert text in output
    element_text = f"{pose_result.triad.matrix[2][2]!r}".encode()
    assert xml.count(element_text) == 1
    file.write_bytes(
        xml.replace(element_text, f"{pose_result.triad.matrix[2][2] + 1e-9!r}".encode())
    )
    assert main(["certificate", "--verify", str(file)]) == 1
    assert "sensitivity.Z" in capsys.readouterr().err


def test_amendment_lists_changed_parameters(tmp_path, pose_result):
    xml = make_document(tmp_path, pose_result, text=OWN)
    changed_xml = xml.replace(b">angle.X.Y<", b">angle.Y.X<")
    parameter_text = format_parameter(pose_result.triad.parameters["angle.X.Y"])
    assert [line for line in describe_changes(xml, changed_xml) if "triad" in line] == [
        f"angle.X.Y of the triad was {parameter_text} and is now not certified.",
        f"angle.Y.X of the triad was not certified and is now {parameter_text}.",
    ]


def format_parameter(parameter):
    """Format a parameter with U as an amendment does."""
    unit, factor = find_display_unit(parameter.unit)
    return format_estimate(
        parameter.value * factor, coverage_factor(16.0) * parameter.u * factor, unit
    )


def test_matrix_and_bias_correct_indications(tmp_path, pose_result):
    xml = make_document(tmp_path, pose_result, text=OWN)
    output = f"{PART}[dcc:name/dcc:content='Corrected output']"
    matrix = _read_numbers(xml, f"{output}//dcc:quantity[1]//si:valueXMLList").reshape(3, 3)
    bias = _read_numbers(xml, f"{output}//dcc:quantity[2]//si:valueXMLList")
    directions = triads.draw_directions(5, np.random.default_rng(8))
    corrected = (G * triads.compute_indications(directions) - bias) @ matrix.T
    np.testing.assert_allclose(corrected, G * directions, atol=5.0 * G * 3e-4)
    np.testing.assert_allclose(bias, G * triads.BIAS, atol=5.0 * G * 3e-4)
    expanded = _read_numbers(xml, f"{output}//si:valueExpandedMUXMLList").reshape(3, 3)
    np.testing.assert_allclose(
        expanded, coverage_factor(16.0) * np.array(pose_result.triad.u_matrix)
    )
    assert np.all(np.abs(matrix - np.linalg.inv(triads.ROWS)) <= 2.0 * expanded)


@needs_schema
def test_triad_certificate_conforms_to_schema(tmp_path, pose_result):
    check_schema(make_document(tmp_path, pose_result, text=OWN), SCHEMA, "a triad's certificate")


def test_pages_and_xml_have_equal_statements(tmp_path, pose_result):
    lab = read_lab_for(tmp_path, pose_result, OWN)
    (statement_lines,) = (
        statement
        for statement in certificate_statements(lab, pose_result, pose_result, ISSUE, {})
        if statement.name == "Triad X, Y, Z"
    )
    assert "25 poses of unknown attitude" in " ".join(statement_lines.lines)
    declared = find_elements(
        make_document(tmp_path, pose_result, text=OWN),
        "//dcc:statement[dcc:name/dcc:content='Triad X, Y, Z']/dcc:declaration/dcc:content",
    )
    assert declared[0].text == "\n".join(statement_lines.lines)
    blocks = _page_blocks(tmp_path, pose_result)
    paragraphs = [block.text for block in blocks if isinstance(block, Paragraph)]
    plain_paragraphs = [text.replace("²", "^2").replace("\u00a0", " ") for text in paragraphs]
    assert set(statement_lines.lines) <= set(plain_paragraphs)
    tables = {block.columns[0].title: block for block in blocks if isinstance(block, Table)}
    parameter_names = [row[0] for row in tables["Parameter"].rows]
    assert parameter_names[0] == "offset of X"
    assert parameter_names[-1] == "angle between Y and Z minus 90 deg"
    assert [row[0] for row in tables["M ± U"].rows] == ["f_x", "f_y", "f_z"]
    assert tables["M ± U"].rows[0][2:4] == ("0", "0")  # zero by definition of the frame


def test_method_statement_describes_poses(tmp_path, pose_result):
    method = find_elements(
        make_document(tmp_path, pose_result, text=OWN), "//dcc:usedMethod[1]/dcc:description"
    )
    text = "".join(method[0].itertext())
    assert "Readings at rest in 25 poses of unknown attitude." in text
    assert "turntable" not in text
    assert "spindle" not in text


def test_two_accelerometers_have_no_triad_section(tmp_path, pose_result):
    text = OWN.replace("[certificate]", '[certificate]\naccelerometers = ["X", "Y"]')
    assert b"Triad" not in make_document(tmp_path, pose_result, text=text)
    assert not any("Triad" in str(block) for block in _page_blocks(tmp_path, pose_result, text))


def test_undetermined_parameters_have_no_value(tmp_path):
    faces = np.vstack([np.eye(3), -np.eye(3)])
    model = 'terms = ["K_F", "K_I"]\nassume = ["all"]'
    folder = triads.write_pose_campaign(
        tmp_path / "faces",
        triads.compute_indications(faces),
        u=1e-3,
        description=triads.format_description(model=model),
    )
    result = cs.calibrate(folder)
    angles = [
        parameter for name, parameter in result.triad.parameters.items() if name.startswith("angle")
    ]
    assert not any(parameter.estimated for parameter in angles)
    xml = make_document(tmp_path, result, text=OWN)
    labels = [element.text for element in find_elements(xml, f"{PART}//si:real/si:label")]
    assert labels == [f"{kind}.{name}" for kind in ("offset", "sensitivity") for name in "XYZ"]
    text = "".join(find_elements(xml, "//dcc:statements")[0].itertext())
    assert 'The parameter "angle between X and Y" is not certified' in text


def test_uncertainty_of_parameter_is_at_least_cmc(tmp_path, pose_result):
    cmc = '\n[cmc]\nK_F = "1 mg"\nK_I = "1e-6 g/g"\ndelta_O = "200 arcsec"\ndelta_P = "1 arcsec"\n'
    xml = make_document(tmp_path, pose_result, text=OWN + cmc)
    expanded = {
        element.getparent()
        .getparent()
        .getparent()
        .findtext("si:label", namespaces=NAMESPACES): float(element.text)
        for element in find_elements(xml, f"{PART}//si:real//si:valueExpandedMU")
    }
    assert expanded["offset.Y"] == pytest.approx(1e-3 * G, rel=1e-12)
    assert expanded["angle.X.Z"] == pytest.approx(np.deg2rad(200 / 3600), rel=1e-12)
    parameter = pose_result.triad.parameters["sensitivity.Z"]
    assert expanded["sensitivity.Z"] == pytest.approx(
        coverage_factor(16.0) * parameter.u, rel=1e-12
    )
    text = "".join(find_elements(xml, "//dcc:statements")[0].itertext())
    assert "offset of Y: the evaluated uncertainty is U = " in text
    assert "sensitivity of Z: evaluated" not in text


def test_gravity_uncertainty_moves_between_g_units_and_si(tmp_path, pose_result):
    # Offsets from readings in m/s^2 depend on g in g units and not in m/s^2.
    triad = pose_result.triad
    u_g, parameters, gravity_sensitivities = 1e-2, {}, {}
    for name, parameter in triad.parameters.items():
        gravity_sensitivities[name] = -parameter.value / G if name.startswith("offset") else 0.0
        u = float(np.hypot(parameter.u, gravity_sensitivities[name] * u_g))
        parameters[name] = parameter.model_copy(update={"u": u, "dof": None})
    calibration = pose_result.model_copy(
        update={
            "inputs": pose_result.inputs.model_copy(update={"u_gravity": u_g}),
            "triad": triad.model_copy(
                update={
                    "parameters": parameters,
                    "by_gravity": gravity_sensitivities,
                    "correlation": Correlation(terms=list(parameters), matrix=np.eye(9).tolist()),
                }
            ),
        }
    )
    expanded = [
        float(element.text)
        for element in find_elements(
            make_document(tmp_path, calibration, text=OWN), f"{PART}//si:real//si:valueExpandedMU"
        )
    ]
    scale = [G] * 3 + [1.0] * 6
    exact = [
        1.96 * factor * parameter.u
        for factor, parameter in zip(scale, triad.parameters.values(), strict=True)
    ]
    assert expanded == pytest.approx(exact, rel=1e-9)
