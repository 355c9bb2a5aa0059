"""`counterspin.frozen` against what `dataclasses.dataclass(frozen=True)` does."""

from __future__ import annotations

import dataclasses
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace
from functools import cached_property

import numpy as np
import pytest

from counterspin.frozen import copy_with, frozen


@frozen
class Quantity:
    """A value."""

    value: float
    unit: str = "m"
    note: str = field(default="", repr=False, compare=False)

    @cached_property
    def doubled(self) -> float:
        """Twice the value."""
        return 2.0 * self.value


@frozen
class Length(Quantity):
    """A derived quantity."""

    digits: int = 3


@frozen(eq=False)
class Samples:
    """With an array."""

    values: np.ndarray


@dataclass(frozen=True)
class Usual:
    """`Quantity` as a dataclass of the standard library."""

    value: float
    unit: str = "m"
    note: str = field(default="", repr=False, compare=False)


def test_frozen_class_behaves_like_dataclass():
    ours, usual = Quantity(2.0, note="x"), Usual(2.0, note="x")
    assert repr(ours) == repr(usual).replace("Usual", f"{Quantity.__qualname__}")
    assert [part.name for part in fields(ours)] == [part.name for part in fields(usual)]
    assert dataclasses.asdict(ours) == dataclasses.asdict(usual)
    assert hash(ours) == hash(usual)
    assert replace(ours, unit="s") == copy_with(ours, {"unit": "s"}) == Quantity(2.0, "s")


def test_equality_and_hash_use_compared_attributes():
    assert Quantity(1.0, note="a") == Quantity(1.0, note="b")
    assert hash(Quantity(1.0, note="a")) == hash(Quantity(1.0, note="b"))
    assert Quantity(1.0) != Quantity(2.0)
    assert Quantity(1.0) != (1.0, "m", "")
    assert Quantity(1.0) != Length(1.0)
    assert Length(1.0, digits=4) != Length(1.0)
    assert len({Quantity(1.0), Quantity(1.0), Quantity(2.0)}) == 2


def test_object_with_array_equals_only_itself():
    samples = Samples(np.zeros(3))
    assert samples != Samples(samples.values)
    assert {samples: 1}[samples] == 1


@pytest.mark.parametrize("name", ["value", "unit", "unknown"])
def test_changing_or_deleting_attribute_raises(name):
    quantity = Length(1.0)
    with pytest.raises(FrozenInstanceError, match=f"cannot change '{name}' of a Length"):
        setattr(quantity, name, 2.0)
    with pytest.raises(FrozenInstanceError, match=f"cannot change '{name}'"):
        delattr(quantity, name)
    assert quantity == Length(1.0)


def test_cached_property_survives_pickling():
    quantity = Length(1.5)
    assert quantity.doubled == 3.0
    assert "doubled" in vars(quantity)
    assert pickle.loads(pickle.dumps(quantity)) == quantity
