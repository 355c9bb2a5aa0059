"""The unit of a signal, by its wave."""

import numpy as np
import pytest
from record_files import RATE, SIGNAL, read, refusal, table, write


@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e2])
@pytest.mark.parametrize("place", [300, 1500, 2700])
@pytest.mark.parametrize("start", [False, True])
def test_a_unit_that_changes_on_the_way(tmp_path, factor, place, start):
    columns = table(n=3000)
    part = slice(None, place) if start else slice(place, None)
    columns[SIGNAL][part] *= factor
    message = refusal(write(tmp_path / "run.csv", columns))
    assert "changes its unit" in message
    found = int(message.split("line ")[1].split(":")[0])
    # Where the wave crosses zero, one unit is as good as the other.
    assert abs(found - 2 - place) <= 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: 1e3 * s, "m and mm"),
        (lambda s: 0.0 * s, "swings by 0 m"),
        (lambda s: 0.2 * s, "make 2.5 m: check the column's unit, the radius and the input axis"),
        (lambda s: -s, "180 degrees"),
        (lambda s: np.roll(s, 25), "check the input axis"),
    ],
)
def test_a_displacement_that_is_not_the_motions(tmp_path, change, words):
    columns = table(n=3000)
    columns[SIGNAL] = change(columns[SIGNAL])
    assert words in refusal(write(tmp_path / "run.csv", columns))


def test_other_observables_are_not_held_to_the_radius(tmp_path):
    columns = table(n=3000)
    columns[SIGNAL] *= -RATE * 10
    read(write(tmp_path / "run.csv", columns), input_axes={})
