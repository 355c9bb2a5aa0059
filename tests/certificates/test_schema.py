"""A certificate conforms to the DCC schema; schemas are not downloaded."""

import pytest
from raising import raises
from results import CONFORMITY, make_coefficient, make_qx_result

from certificates import SCHEMA, make_document, needs_schema
from counterspin.certificates.schema import check_schema
from counterspin.errors import CounterspinError, RecordError
from counterspin.inference.verdicts import Conformity

#: Schema files as PTB publishes them: each imports the next by its address.
DCC = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:si="https://ptb.de/si"
 targetNamespace="https://ptb.de/dcc" elementFormDefault="qualified">
 <xs:import namespace="https://ptb.de/si" schemaLocation="https://ptb.example/si/v2/SI.xsd"/>
 <xs:element name="a"><xs:complexType><xs:sequence>
  <xs:element ref="si:b" maxOccurs="9"/>
 </xs:sequence></xs:complexType></xs:element>
</xs:schema>"""
SI = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:q="urn:q"
 targetNamespace="https://ptb.de/si" elementFormDefault="qualified">
 <xs:import namespace="urn:q" schemaLocation="../elsewhere/q.xsd"/>
 <xs:element name="b" type="q:number"/>
</xs:schema>"""
Q = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="urn:q">
 <xs:simpleType name="number"><xs:restriction base="xs:integer"/></xs:simpleType>
</xs:schema>"""
GOOD = b'<a xmlns="https://ptb.de/dcc"><b xmlns="https://ptb.de/si">1</b></a>'
BAD = b'<a xmlns="https://ptb.de/dcc">\n <b xmlns="https://ptb.de/si">one</b>\n</a>'


@pytest.fixture
def folder(tmp_path):
    for name, text in (("dcc/v1/dcc.xsd", DCC), ("dcc/si.xsd", SI), ("dcc/deep/er/q.xsd", Q)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path / "dcc"


@needs_schema
def test_complete_certificate_is_valid(tmp_path):
    coefficients = {
        "K_F": make_coefficient(0.005, 1e-9, "g"),
        "K_I": {"value": 1.002, "u": 5e-6, "unit": "g/g", "estimated": False},
        "K_II": make_coefficient(-2.7e-5, 1e-9, "g/g^2", dof=3.5),
    }
    calibration = make_qx_result(coefficients=coefficients, warnings=["Qx: hm"])
    verdicts = {"Qx": {"K_II": Conformity(**CONFORMITY)}}
    xml = make_document(tmp_path, calibration, verdicts=verdicts)
    check_schema(xml, SCHEMA, "x.xml")


@needs_schema
def test_minimal_certificate_is_valid(tmp_path):
    undetermined = {"value": None, "u": None, "unit": "g/g^2", "estimated": False}
    calibration = make_qx_result(coefficients={"K_II": undetermined}, correlation=None)
    calibration = calibration.model_copy(
        update={
            "platform": {},
            "provenance": calibration.provenance.model_copy(update={"inputs": {}}),
        }
    )
    check_schema(make_document(tmp_path, calibration, pages=None), SCHEMA, "x.xml")


@needs_schema
def test_error_states_line(tmp_path):
    xml = make_document(tmp_path, make_qx_result()).replace(b">1.96<", b">1,96<", 1)
    with raises("wrong-document", "x.xml", "line ", "1,96") as error_info:
        check_schema(xml, SCHEMA, "x.xml")
    assert "{https" not in str(error_info.value)


def test_imports_are_resolved_in_folder(folder):
    check_schema(GOOD, folder, "x.xml")
    with raises("wrong-document", "line 2", "'si:b'", "'one'"):
        check_schema(BAD, folder, "x.xml")


def test_rejects_file_that_is_not_xml(folder):
    with pytest.raises(RecordError, match=r"x\.xml is not XML"):
        check_schema(GOOD[:-5], folder, "x.xml")


def test_parent_folder_of_file_is_searched(folder):
    check_schema(GOOD, folder / "v1" / "dcc.xsd", "x.xml")


def test_missing_import_is_not_downloaded(folder):
    (folder / "si.xsd").unlink()
    with raises("wrong-document"):
        check_schema(GOOD, folder, "x.xml")


def test_folder_without_schema_raises(tmp_path):
    with pytest.raises(CounterspinError, match="contains no DCC schema"):
        check_schema(GOOD, tmp_path, "x.xml")
    with pytest.raises(CounterspinError, match="file not found"):
        check_schema(GOOD, tmp_path / "none", "x.xml")
    for name in ("a", "b"):
        (tmp_path / f"{name}.xsd").write_text(DCC)
    with pytest.raises(CounterspinError, match="several DCC schemas"):
        check_schema(GOOD, tmp_path, "x.xml")
