"""The base of all sections of the config, and links to settings that are declared elsewhere."""

from dataclasses import dataclass, fields
from math import inf
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator
from pydantic_core import CoreSchema, core_schema

SIMULATED = "simulated"
"""Port or interface name of the simulated cell; no other value selects it."""
MILLI = 1e-3
"""SI units in one unit of the config, for mm, mm/s and ms."""


class Section(BaseModel):
    """A part of the config: strict, frozen, finite numbers, no unknown keys."""

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    @field_validator("*")
    @classmethod
    def _printable(cls, value: Any) -> Any:
        """Refuse texts with control characters: a terminal would execute them."""
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str) and not text.isprintable():
                raise ValueError("has characters that cannot be printed; write plain text")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """Link from a key of the config to the setting that declares its default and range."""

    owner: type
    """Dataclass with the setting."""
    name: str
    """Field of the owner."""
    unit: float
    """SI units in one unit of the key."""


def setting_of(
    owner: type,
    name: str,
    unit: float = 1.0,
    *,
    at_least: float = -inf,
    at_most: float = inf,
    number: type[int | float] | None = None,
) -> Any:
    """Return a key with default and range of a setting, in a unit of the config.

    Parameters
    ----------
    owner
        Dataclass whose field ``name`` has the metadata ``low``, ``above`` and ``high``.
    unit
        SI units in one unit of the key: `MILLI` for mm and ms.
    at_least, at_most
        Narrower bounds in the key's unit.
    number
        Type of the key if it differs from that of the setting: int for whole ms.
    """
    found = next(one for one in fields(owner) if one.name == name)
    default: Any = found.default
    kind = number or type(default)

    def shown(value: float) -> Any:
        return kind(float(f"{value:.12g}"))

    low = max(found.metadata["low"] / unit, at_least)
    above = found.metadata["above"] / unit
    high = min(found.metadata["high"] / unit, at_most)
    key = Field(
        default=shown(default / unit),
        ge=None if low == -inf else shown(low),
        gt=None if above == -inf else shown(above),
        le=None if high == inf else shown(high),
    )
    key.metadata.append(Declared(owner=owner, name=name, unit=unit))
    return key


def declared_values(section: BaseModel, owner: type) -> dict[str, Any]:
    """Return the values of an owner's settings in a section and its subsections, in SI, by name."""
    values: dict[str, Any] = {}
    for name, key in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            values |= declared_values(value, owner)
        for link in key.metadata:
            if isinstance(link, Declared) and link.owner is owner:
                values[link.name] = value if link.unit == 1.0 else value * link.unit
    return values


@dataclass(frozen=True, slots=True)
class OneOf:
    """Annotation of a text with a table of allowed names: ``Annotated[str, OneOf(...)]``."""

    names: tuple[str, ...]
    """The names, in the order of the table."""

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> CoreSchema:
        return core_schema.literal_schema(list(self.names))
