"""Country and language codes in force."""

import json
from pathlib import Path

import pytest
from results import make_qx_result

from certificates import LAB, read_lab_for
from counterspin.certificates.codes import check_code, codes_in_force
from counterspin.errors import CampaignError

#: Lists of the Debian package iso-codes, if installed.
DEBIAN = Path("/usr/share/iso-codes/json")


def test_code_lists_have_size_of_standards():
    # ISO 3166-1: 249 entries. ISO 639-1: 183 codes, without the withdrawn "bh".
    assert [len(codes_in_force(kind)) for kind in ("country", "language")] == [249, 183]
    assert all(code.isascii() and code.isupper() for code in codes_in_force("country"))
    assert all(code.isascii() and code.islower() for code in codes_in_force("language"))


@pytest.mark.skipif(not DEBIAN.is_dir(), reason="iso-codes is not installed")
def test_code_lists_match_debian():
    def read_codes(name, key):
        (entries,) = json.loads((DEBIAN / name).read_text("utf-8")).values()
        return {entry[key] for entry in entries if key in entry}

    assert set(codes_in_force("country")) == read_codes("iso_3166-1.json", "alpha_2")
    assert set(codes_in_force("language")) == read_codes("iso_639-2.json", "alpha_2") - {"bh"}


@pytest.mark.parametrize(
    ("kind", "wrong", "near"),
    [
        ("country", "DD", '"DE" (Germany)'),
        ("country", "SU", '"RU" (Russian Federation)'),
        ("country", "YU", '"RS" (Serbia)'),
        ("country", "UK", '"GB" (United Kingdom)'),
        ("country", "VD", '"VN" (Vietnam)'),
        ("country", "fr", '"FR" (France)'),
        ("country", "Swizerland", '"CH" (Switzerland)'),
        ("language", "iw", '"he" (Hebrew)'),
        ("language", "ji", '"yi" (Yiddish)'),
        ("language", "sh", '"sr" (Serbian)'),
        ("language", "french", '"fr" (French)'),
    ],
)
def test_withdrawn_code_is_rejected_with_suggestions(kind, wrong, near):
    with pytest.raises(ValueError, match="is not a current") as error_info:
        check_code(wrong, kind)
    assert near in str(error_info.value)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('country = "DE"', 'country = "DD"', "laboratory.country"),
        ('language = "de"', 'language = "iw"', "certificate.language"),
    ],
)
def test_message_names_key(tmp_path, old, new, key):
    with pytest.raises(CampaignError) as error_info:
        read_lab_for(tmp_path, make_qx_result(), LAB.replace(old, new))
    (problem,) = error_info.value.problems
    assert problem.startswith(f"{key}: ")
    assert "did you mean" in problem
