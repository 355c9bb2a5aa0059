"""Which three columns may be the axes of a sensor."""

import numpy as np

from counterspin.ingest.contents import FileColumn
from counterspin.ingest.triads import candidate_triples


def find_names(*names):
    columns = [FileColumn(name, "", np.zeros(3)) for name in names]
    return [tuple(one.name for one in three) for three in candidate_triples(columns)]


def test_names_differing_in_axis_letter_are_triad():
    assert find_names("z", "y", "x") == [("x", "y", "z")]
    assert find_names("t", "ax", "gx", "ay", "gy", "az", "gz")[:2] == [
        ("ax", "ay", "az"),
        ("gx", "gy", "gz"),
    ]
    # An x in the name of all three is none of an axis.
    assert find_names("xsens_Y", "xsens_X", "xsens_Z") == [("xsens_X", "xsens_Y", "xsens_Z")]
    assert find_names("X", "y", "Z") == [("X", "y", "Z")]  # as they follow one another


def test_consecutive_columns_without_axis_letters_are_triad():
    assert find_names("1", "2", "3", "4") == [("1", "2", "3"), ("2", "3", "4")]
    # No column of a named sensor is one of another.
    assert find_names("ax", "ay", "az", "m1", "m2", "m3") == [
        ("ax", "ay", "az"),
        ("m1", "m2", "m3"),
    ]
    assert find_names("ax", "ay") == []


def test_filtered_gravity_is_ranked_after_sensor():
    names = [f"{text} {axis}" for text in ("GRAVITY", "ACCELEROMETER") for axis in "XYZ"]
    assert [three[0] for three in find_names(*names)] == ["ACCELEROMETER X", "GRAVITY X"]
