"""The pages of a certificate: equipment, budgets, basis."""

from results import make_qx_result

from certificates import (
    ISSUE,
    LAB,
    SCHEMA,
    find_elements,
    make_document,
    needs_schema,
    read_lab_for,
)
from counterspin.certificates.pdf_pages import page_blocks
from counterspin.certificates.schema import check_schema
from counterspin.reports.blocks import Heading, Table

EQUIPMENT = """
[[equipment]]
name = "Interferometer"
manufacturer = "Werk"
model = "LI-2"
serial_number = "1138"
quantity = "radius"
certificate = "4711"
calibrated_by = "Institut"
due = 2027-06-01

[[equipment]]
name = "Frequenznormal"
"""


def make_blocks(tmp_path, text=LAB):
    calibration = make_qx_result()
    return list(page_blocks(read_lab_for(tmp_path, calibration, text), calibration, ISSUE, {}))


def find_table(blocks, title):
    heading_index = next(
        k for k, block in enumerate(blocks) if isinstance(block, Heading) and block.text == title
    )
    table = blocks[heading_index + 1]
    assert isinstance(table, Table)
    return table


def test_equipment_table_precedes_results(tmp_path):
    blocks = make_blocks(tmp_path, LAB + EQUIPMENT)
    table = find_table(blocks, "Equipment and traceability")
    assert table.rows == (
        ("Interferometer", "Werk, LI-2", "1138", "radius", "4711", "Institut", "2027-06-01"),
        ("Frequenznormal", "", "", "", "", "", ""),
    )
    titles = [block.text for block in blocks if isinstance(block, Heading) and block.level == 2]
    assert titles.index("Equipment and traceability") < titles.index("Results")
    assert "Equipment and traceability" not in [
        block.text for block in make_blocks(tmp_path) if isinstance(block, Heading)
    ]


def test_budget_follows_results_and_names_coefficient(tmp_path):
    table = find_table(make_blocks(tmp_path), "Uncertainty budget of K_II, Qx")
    assert [row[0] for row in table.rows] == ["noise of Qx", "K_I", "combined"]
    assert table.columns[-1].title == "Share of u²"
    assert [row[-1] for row in table.rows] == ["64 %", "36 %", ""]


@needs_schema
def test_equipment_conforms_to_schema(tmp_path):
    check_schema(
        make_document(tmp_path, make_qx_result(), text=LAB + EQUIPMENT), SCHEMA, "certificate"
    )


def test_equipment_is_in_xml(tmp_path):
    xml = make_document(tmp_path, make_qx_result(), text=LAB + EQUIPMENT)
    names = find_elements(xml, "//dcc:measuringEquipment/dcc:name/dcc:content/text()")
    assert names == ["Interferometer", "Frequenznormal"]
    (number,) = find_elements(xml, "//dcc:measuringEquipment//dcc:value/text()")
    assert number == "1138"
    (text,) = find_elements(xml, "//dcc:measuringEquipment/dcc:description/dcc:content/text()")
    assert text.splitlines() == [
        "Quantity: radius.",
        "Calibration certificate: 4711.",
        "Calibrated by: Institut.",
        "Next calibration due: 2027-06-01.",
    ]


def test_no_equipment_omits_list(tmp_path):
    assert (
        find_elements(make_document(tmp_path, make_qx_result()), "//dcc:measuringEquipments") == []
    )
