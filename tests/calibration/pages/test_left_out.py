"""What a reader is told of the terms that a model leaves out."""

from results import coefficient, result

from counterspin.calibration.pages.left_out import left_out_blocks, left_out_sentence
from counterspin.reports.blocks import Table

KNOWN = {
    "K_F": coefficient(0.005, 1e-6, "g"),
    "K_II": coefficient(2.7e-5, 1e-9, "g/g^2"),
}
LEFT_OUT = {
    "K_IP": {"sensitivity": 0.1, "unit": "g/g^2", "typical": 2e-6, "moves": {"K_II": 0.1}},
    "K_OO": {"sensitivity": 1.0, "unit": "g/g^2", "typical": 2e-6, "moves": {"K_II": 1.0}},
    "K_PP": {"sensitivity": 0.0, "unit": "g/g^2", "typical": 2e-6, "moves": {"K_F": -1.0}},
    "delta_O": {
        "sensitivity": 1e-6,
        "unit": "rad",
        "typical": 5e-5,
        "moves": {"K_II": 1e-6, "K_F": 1.0},
    },
    "K_IO": {"sensitivity": 1e-4, "unit": "g/g^2", "typical": 2e-6, "moves": {"K_II": 1e-4}},
}


def found(left_out):
    return result(coefficients=KNOWN, left_out=left_out).accelerometers["Qx"]


def test_each_term_that_decides_is_named_once():
    assert left_out_sentence(found(LEFT_OUT)) == (
        "Not in the model, and so not in u; typical sizes would move K_II by 2 ug/g^2 (K_OO, "
        "2 ug/g^2), and less by K_IP; K_F by 50 ug (delta_O, 10 arcsec), and less by K_PP."
    )
    assert left_out_sentence(found({"K_IO": LEFT_OUT["K_IO"]})) == ""


def test_table_has_the_size_of_every_effect():
    _, _, table = left_out_blocks(found(LEFT_OUT))
    assert isinstance(table, Table)
    assert [column.title for column in table.columns] == [
        "Left out",
        "Typical size",
        "K_II, ug/g^2",
        "K_F, ug",
    ]
    assert table.rows == (
        ("K_OO", "2 ug/g^2", "2", ""),
        ("K_IP", "2 ug/g^2", "0.2", ""),
        ("delta_O", "10 arcsec", "5e-5", "50"),
        ("K_PP", "2 ug/g^2", "", "2"),
    )
    assert list(left_out_blocks(found({}))) == []
