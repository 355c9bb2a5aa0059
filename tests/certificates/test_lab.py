"""Missing laboratory data are reported together; stated data are checked."""

import pytest
from raising import raises
from results import make_qx_result

from certificates import LAB, read_lab_for, write_lab
from counterspin.certificates.lab import read_lab, template_keys, write_example
from counterspin.errors import CampaignError, CounterspinError


def list_problems(folder, text, calibration=None):
    with pytest.raises(CampaignError) as error_info:
        read_lab(write_lab(folder, text), calibration or make_qx_result())
    return error_info.value.problems


def test_all_missing_keys_are_reported(tmp_path):
    assert list_problems(tmp_path, "schema = 1") == (
        "certificate.begin: is missing",
        "certificate.end: is missing",
        "certificate.traceability: is missing",
        "laboratory.name: is missing",
        "laboratory.city: is missing",
        "laboratory.country: is missing",
        "customer.name: is missing",
        "customer.city: is missing",
        "item.name: is missing",
        "item.manufacturer: is missing",
        "item.model: is missing",
        "item.serial_number: is missing",
        "persons[0].name: is missing",
        "persons[0].role: is missing",
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "Kunde"', 'name = "  "', "customer.name: must not be empty"),
        ('name = "Kunde"', 'name = "a\\u0007b"', "customer.name: contains a control character"),
        ('number = "7"', 'nummer = "7"', 'customer.nummer: unknown key; did you mean "number"?'),
        ("2026-01-14", "2026-01-11", "certificate.end: lies before certificate.begin"),
        ('language = "de"', 'language = "German"', 'certificate.language: "German" is not'),
        ('country = "DE"', 'country = "Germany"', 'laboratory.country: "Germany" is not'),
        ('language = "de"', 'place = "lab"', "certificate.place: 'lab' is not one of"),
        ('language = "de"', "issued = 2026-01-13", "certificate.issued: lies before"),
        ('language = "de"', "received = 2026-01-13", "certificate.received: lies after"),
        (
            'language = "de"',
            'ledger = "../l"',
            "certificate.ledger: must be in the same folder as this file",
        ),
        ('language = "de"', "accelerometers = []", "certificate.accelerometers: must have"),
        ('language = "de"', 'accelerometers = ["Qy"]', 'accelerometers[0]: the result has no "Qy"'),
        (
            'language = "de"',
            'accelerometers = ["Qx", "Qx"]',
            'accelerometers[1]: "Qx" occurs twice; keep only one of them',
        ),
        (
            'language = "de"',
            'identifier = "Draft 7"',
            "identifier: must not begin with DRAFT",
        ),
        ("degC", "K", 'conditions.temperature: must be a temperature, such as "20.0 ± 0.3 degC"'),
        ("[conditions]", "[accelerometers.Qz]\n[conditions]", "accelerometers.Qz: the result has"),
        (
            "[conditions]",
            '[accelerometers.Qx]\nserial_number = "1"\n[conditions]',
            'accelerometers.Qx.serial_number: is "1", but the result is for "Q-104"',
        ),
        (
            "[conditions]",
            '[specification]\nK_II = "abs <= 5e-5 g"\n[conditions]',
            "specification.K_II: 'g' is not a unit of second-order coefficient",
        ),
    ],
)
def test_error_names_key(tmp_path, old, new, message):
    assert old in LAB
    (problem,) = list_problems(tmp_path, LAB.replace(old, new, 1))
    assert message in problem


@pytest.mark.parametrize(
    ("item", "accelerometer", "is_valid"),
    [
        ("P-3", "Q-104", True),
        ("Q-104", "Q-104", True),  # the item is the accelerometer
        ("Q-1", None, True),  # the campaign does not state the accelerometer's number
        ("000000", "Q-104", True),  # of the template: the certificate is a draft
        ("P-4", "Q-104", False),
    ],
)
def test_item_has_serial_number_of_campaign(tmp_path, item, accelerometer, is_valid):
    result = make_qx_result(serial_number=accelerometer)
    result = result.model_copy(update={"details": {"serial_number": "P-3"}})
    text = LAB.replace("0815", item)
    if is_valid:
        assert read_lab_for(tmp_path, result, text).item.serial_number == item
        return
    with raises("conflicting-values", "item.serial_number", f'"{item}"', '"P-3"'):
        read_lab_for(tmp_path, result, text)


def test_missing_file_error_names_write_example(tmp_path):
    with pytest.raises(CampaignError, match=r"`certificates\.lab\.write_example` writes"):
        read_lab(tmp_path / "LAB.toml", make_qx_result())


def test_example_is_valid_and_recognised_as_template(tmp_path):
    path = write_example(tmp_path / "LAB.toml")
    lab, specifications = read_lab(path, make_qx_result())
    assert specifications is None
    keys = template_keys(lab)
    # Every key of the template that has a value, except its format.
    assert len(keys) == 15
    assert {"certificate.begin", "customer.country", "item.model", "item.serial_number"} < {*keys}
    assert {"laboratory.name", "certificate.traceability", "persons[0].name"} < {*keys}
    text = path.read_text("utf-8").replace("Example Customer", "Somebody")
    assert "customer.name" not in template_keys(read_lab_for(tmp_path, make_qx_result(), text))
    assert template_keys(read_lab_for(tmp_path, make_qx_result())) == []
    with pytest.raises(CounterspinError, match="exists"):
        write_example(path)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("2026-01-12", "2000-01-01", "certificate.begin"),
        ('"D-K-1"', '"Example D-K-00000-00-00"', "laboratory.code"),
        ('"Weg"', '"Example Street"', "customer.street"),
        ('"12345"', '"00000"', "customer.post_code"),
        ('"P-1"', '"EX-1"', "item.model"),
        ('"0815"', '"000000"', "item.serial_number"),
        ('"B. Zweite"', '"E. Xample"', "persons[1].name"),
        (
            "[conditions]",
            '[accelerometers.Qx]\nmodel = "Example 1"\n[conditions]',
            "accelerometers.Qx.model",
        ),
    ],
)
def test_template_values_are_found_in_all_tables(tmp_path, old, new, key):
    assert template_keys(read_lab_for(tmp_path, make_qx_result(), LAB.replace(old, new, 1))) == [
        key
    ]


def test_specification_uses_site_gravity(tmp_path):
    text = LAB + '\n[specification]\nK_F = "abs <= 0.098 m/s^2"\n'
    _, specifications = read_lab(write_lab(tmp_path, text), make_qx_result())
    assert specifications.terms["Qx"]["K_F"].high == pytest.approx(0.01, rel=1e-14)
