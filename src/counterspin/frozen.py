"""Dataclasses whose objects cannot be changed, as every room uses them.

`dataclasses.dataclass(frozen=True)` compiles six methods for each class while the package is
loaded; for all classes of a calibration together that took longer than its fit. Here a class gets
one of its own, `__init__`; the others are shared. `dataclasses.replace`, `fields` and the like work
as usual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError, dataclass, field, fields
from operator import attrgetter
from typing import Any, NoReturn, TypeVar, dataclass_transform, overload

Kind = TypeVar("Kind", bound=type)
T = TypeVar("T")


@overload
def frozen(cls: Kind, /) -> Kind: ...
@overload
def frozen(*, eq: bool) -> Callable[[Kind], Kind]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class a dataclass whose attributes are set once, by `__init__`.

    eq: Whether two objects with equal attributes are equal, and have one hash. False where an
        attribute is an array, which has no single truth: then an object equals itself alone.
    """
    if cls is None:
        return lambda it: frozen(it) if eq else _frozen(it, {})
    return _frozen(cls, {"__eq__": _equal, "__hash__": _hash})


def _frozen(cls: Any, comparing: dict[str, Any]) -> Any:
    shared = {"__repr__": _repr, "__setattr__": _set_once, "__delattr__": _refuse} | comparing
    for name, method in shared.items():
        if name not in vars(cls):
            setattr(cls, name, method)
    made = dataclass(eq=False, repr=False)(cls)
    if comparing:
        # Quick, since dictionaries of terms compare them by the thousand.
        made._compared = attrgetter(*(part.name for part in fields(made) if part.compare))
    return made


def copy_with(instance: T, changes: Mapping[str, Any]) -> T:
    """Return a copy of a frozen object with changed attributes.

    It is quicker than `dataclasses.replace` because `__init__` does not run. The class may not have
    attributes that are computed once.
    """
    copy = object.__new__(type(instance))
    copy.__dict__.update(instance.__dict__, **changes)
    return copy


def _set_once(self: Any, name: str, value: Any) -> None:
    own = self.__dict__
    if name in own or name not in self.__dataclass_fields__:
        _refuse(self, name)
    own[name] = value


def _refuse(self: Any, name: str) -> NoReturn:
    raise FrozenInstanceError(f"cannot change {name!r} of a {type(self).__qualname__}")


def _repr(self: Any) -> str:
    shown = (f"{part.name}={getattr(self, part.name)!r}" for part in fields(self) if part.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _equal(self: Any, other: Any) -> Any:
    if type(other) is not type(self):
        return NotImplemented
    compared: Callable[[Any], Any] = type(self)._compared
    return compared(self) == compared(other)


def _hash(self: Any) -> int:
    return hash(type(self)._compared(self))
