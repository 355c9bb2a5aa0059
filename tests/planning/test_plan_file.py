"""What a plan's file may ask for."""

import pytest

from counterspin.errors import CampaignError
from counterspin.planning.plan_file import read_plan


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fewest_revolutions = 5", "fewest_revolutions = 1e-12", "must be at least one revolution"),
        ('highest_rate = "1 rev/s"', 'highest_rate = "1e30 rev/s"', "samples at 50 Hz; give a"),
        ('sampling_rate = "50 Hz"', 'sampling_rate = "1e-9 Hz"', "5e-09 samples at 1e-09 Hz"),
        (
            'total_time = "700 s"',
            'total_time = "1e11 s"',
            "longer than the longest possible record",
        ),
    ],
)
def test_implausible_machine_sizes_raise_with_reason(write_starter, old, new, words):
    """A search among these ended in an error of its own."""
    with pytest.raises(CampaignError) as caught:
        read_plan(write_starter((old, new)))
    assert any(words in problem for problem in caught.value.problems), caught.value
