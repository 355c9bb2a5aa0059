"""Arguments of `counterspin apply`."""

import pytest

from counterspin.cli.apply import parse_others
from counterspin.errors import CampaignError


def test_other_accelerometers_are_parsed_as_pairs():
    assert parse_others(None) == {}
    assert parse_others("Qy=a, Qz = b c") == {"Qy": "a", "Qz": "b c"}
    for wrong in ("Qy", "Qy=", "=a", "Qy=a,Qy=b", "Qy=a,"):
        with pytest.raises(CampaignError, match="not of the form"):
            parse_others(wrong)
