"""Immutable dataclasses that load quickly.

`dataclasses.dataclass(frozen=True)` compiles six methods for each class while the package is
loaded; for all classes of a calibration together, that takes longer than the fit. Here only
`__init__` is compiled for each class, and the other methods are shared. `dataclasses.replace`,
`fields` and similar functions work as usual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError, dataclass, field, fields
from operator import attrgetter
from typing import Any, NoReturn, TypeVar, dataclass_transform, overload

ClassT = TypeVar("ClassT", bound=type)
T = TypeVar("T")


@overload
def frozen(cls: ClassT, /) -> ClassT: ...
@overload
def frozen(*, eq: bool) -> Callable[[ClassT], ClassT]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class a dataclass whose attributes are set once, by `__init__`.

    eq: Whether objects with equal attributes are equal and have the same hash. False for classes
        with array attributes, which have no single truth value: an object then equals only itself.
    """
    if cls is None:
        return lambda cls: frozen(cls) if eq else _make_frozen(cls, {})
    return _make_frozen(cls, {"__eq__": _equal, "__hash__": _hash})


def _make_frozen(cls: Any, comparison_methods: dict[str, Any]) -> Any:
    methods = {
        "__repr__": _repr,
        "__setattr__": _set_attribute_once,
        "__delattr__": _reject_change,
    } | comparison_methods
    for name, method in methods.items():
        if name not in vars(cls):
            setattr(cls, name, method)
    new_class = dataclass(eq=False, repr=False)(cls)
    if comparison_methods:
        # `attrgetter` is fast: dictionaries compare thousands of terms.
        new_class._compared = attrgetter(
            *(attribute.name for attribute in fields(new_class) if attribute.compare)
        )
    return new_class


def copy_with(instance: T, changes: Mapping[str, Any]) -> T:
    """Return a copy of a frozen object with changed attributes.

    This is faster than `dataclasses.replace` because `__init__` does not run. The class must not
    have cached attributes.
    """
    copy = object.__new__(type(instance))
    copy.__dict__.update(instance.__dict__, **changes)
    return copy


def _set_attribute_once(self: Any, name: str, value: Any) -> None:
    attributes = self.__dict__
    if name in attributes or name not in self.__dataclass_fields__:
        _reject_change(self, name)
    attributes[name] = value


def _reject_change(self: Any, name: str) -> NoReturn:
    raise FrozenInstanceError(f"cannot change {name!r} of a {type(self).__qualname__}")


def _repr(self: Any) -> str:
    arguments = (
        f"{attribute.name}={getattr(self, attribute.name)!r}"
        for attribute in fields(self)
        if attribute.repr
    )
    return f"{type(self).__qualname__}({', '.join(arguments)})"


def _equal(self: Any, other: Any) -> Any:
    if type(other) is not type(self):
        return NotImplemented
    compared_attributes: Callable[[Any], Any] = type(self)._compared
    return compared_attributes(self) == compared_attributes(other)


def _hash(self: Any) -> int:
    return hash(type(self)._compared(self))
