"""Sentences of a certificate: ± has one meaning, and dimensionless numbers have no unit."""

from results import make_coefficient, make_qx_result

from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates import certificate_text
from counterspin.certificates.conversion import coefficients_in_si
from counterspin.certificates.pdf_pages import results_table


def test_plus_minus_in_sentences_becomes_u():
    sentence = (
        "A latitude of (-4.7 ± 1.1) x 1e4 arcsec would fit; determined: K_I = 1.002 ± 0.001 g/g."
    )
    assert certificate_text.replace_plus_minus(sentence) == (
        "A latitude of -4.7 x 1e4, u = 1.1 x 1e4 arcsec would fit; determined: K_I = 1.002, "
        "u = 0.001 g/g."
    )


def test_dimensionless_number_has_no_unit():
    calibration = make_qx_result(
        coefficients={"K_I": make_coefficient(1.002, 5e-6, "g/g")}, correlation=None
    )
    coefficients = calibration.accelerometers["Qx"].coefficients
    ((symbol, in_g, _, si, *_),) = results_table(
        "Qx", coefficients, coefficients_in_si(calibration, "Qx")
    ).rows
    assert (symbol, in_g, si) == ("K_I", "1.0020000 ± 0.0000098 g/g", "1.0020000 ± 0.0000098")
    assert certificate_text.coefficient_line("K_I", coefficients["K_I"]).endswith(
        "The value in this element is a dimensionless number."
    )
    k_ii = Coefficient.model_validate(make_coefficient(2.7e-5, 1e-9, "g/g^2"))
    assert certificate_text.coefficient_line("K_II", k_ii).endswith(
        "in this element is in m^-1 s^2."
    )
