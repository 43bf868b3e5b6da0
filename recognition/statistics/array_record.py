"""Records of arrays, stored in a model under the names of their fields."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrayRecord:
    """A record that has only arrays as fields."""

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Return the fields under names that begin with the prefix."""
        return {prefix + one.name: getattr(self, one.name) for one in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Self:
        """Rebuild from `to_arrays`; KeyError if an array is missing."""
        return cls(**{one.name: arrays[prefix + one.name] for one in fields(cls)})


def without_prefix(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with a prefix, under the rest of their names."""
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
