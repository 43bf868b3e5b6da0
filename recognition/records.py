"""Records: frozen dataclasses that become plain arrays for a file, and come back from them."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from math import isfinite
from types import NoneType
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
"""Plain arrays by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """Base of records of numbers, which files keep as rows.

    Raises ValueError if a number is not finite, or a deviation (``_sd``) not above 0.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isfinite(value) or (field.name.endswith("_sd") and value <= 0.0):
                raise ValueError(
                    f"{field.name} of a {type(self).__name__} is {value}, must be finite, an sd "
                    "above 0"
                )

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers in the order of the fields."""
        return astuple(self)

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Self:
        """Rebuild from `values`. Raises ValueError if they do not fit."""
        names = (field.name for field in fields(cls))
        return cls(**dict(zip(names, map(float, values), strict=True)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrayRecord:
    """Base of records of arrays, numbers, texts, tuples of these, and further records."""

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Return the fields under names that begin with the prefix; None is left out."""
        arrays: dict[str, NDArray[Any]] = {}
        for field in fields(self):
            name, value = prefix + field.name, getattr(self, field.name)
            if isinstance(value, ArrayRecord):
                arrays |= value.to_arrays(f"{name}_")
            elif value is not None:
                arrays[name] = np.asarray(value.values if isinstance(value, Numbers) else value)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Arrays, prefix: str = "") -> Self:
        """Rebuild from `to_arrays`.

        Raises KeyError for a missing array, ValueError or TypeError for one that does not fit.
        """
        kinds = get_type_hints(cls)
        names = [field.name for field in fields(cls)]
        return cls(**{name: _rebuilt(kinds[name], arrays, prefix + name) for name in names})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtRecord(ArrayRecord):
    """Base of taught recognizers: their arrays have a version."""

    version: ClassVar[int]
    """Version of the arrays and their use; models of another version are refused."""

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays."""
        return {"version": np.array(self.version), **ArrayRecord.to_arrays(self, prefix)}

    @classmethod
    def from_arrays(cls, arrays: Arrays, prefix: str = "") -> Self:
        """Rebuild from `to_arrays`. Raises ValueError that names a missing or wrong array."""
        try:
            if (version := int(arrays["version"])) != cls.version:
                raise ValueError(
                    f"the model has features of version {version}, not {cls.version}: train again"
                )
            return super(TaughtRecord, cls).from_arrays(arrays, prefix)
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing


def _rebuilt(kind: Any, arrays: Arrays, name: str) -> Any:
    """Return the value of a field of some kind from its array, or the arrays of its record."""
    if NoneType in get_args(kind):
        if not any(key == name or key.startswith(f"{name}_") for key in arrays):
            return None
        (kind,) = (member for member in get_args(kind) if member is not NoneType)
    origin = get_origin(kind) or kind
    if issubclass(origin, ArrayRecord):
        return origin.from_arrays(arrays, f"{name}_")
    array = arrays[name]
    if issubclass(origin, np.ndarray):
        return array
    if issubclass(origin, Numbers):
        return origin.from_values(array.tolist())
    if origin is tuple:
        return tuple(map(get_args(kind)[0], array.tolist()))
    return kind(array.item())
