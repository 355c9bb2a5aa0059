"""Which three columns may be the axes of a sensor."""

import numpy as np

from counterspin.ingest.contents import FileColumn
from counterspin.ingest.triads import threes


def found(*names):
    columns = [FileColumn(name, "", np.zeros(3)) for name in names]
    return [tuple(one.name for one in three) for three in threes(columns)]


def test_names_that_differ_in_the_letters_of_axes_belong_together():
    assert found("z", "y", "x") == [("x", "y", "z")]
    assert found("t", "ax", "gx", "ay", "gy", "az", "gz")[:2] == [
        ("ax", "ay", "az"),
        ("gx", "gy", "gz"),
    ]
    # An x in the name of all three is none of an axis.
    assert found("xsens_Y", "xsens_X", "xsens_Z") == [("xsens_X", "xsens_Y", "xsens_Z")]
    assert found("X", "y", "Z") == [("X", "y", "Z")]  # as they follow one another


def test_columns_without_such_names_belong_together_where_they_follow_one_another():
    assert found("1", "2", "3", "4") == [("1", "2", "3"), ("2", "3", "4")]
    # No column of a named sensor is one of another.
    assert found("ax", "ay", "az", "m1", "m2", "m3") == [("ax", "ay", "az"), ("m1", "m2", "m3")]
    assert found("ax", "ay") == []


def test_what_a_filter_makes_of_gravity_stands_behind_a_sensor():
    names = [f"{what} {axis}" for what in ("GRAVITY", "ACCELEROMETER") for axis in "XYZ"]
    assert [three[0] for three in found(*names)] == ["ACCELEROMETER X", "GRAVITY X"]
