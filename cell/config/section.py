"""The base of all sections of the config, and links to settings that are declared elsewhere."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from math import inf, isfinite
from typing import Any, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    field_validator,
)
from pydantic_core import CoreSchema, core_schema

from cell.errors import ConfigError, raised_as
from cell.plugins import Plugins

SIMULATED = "simulated"
"""Port or interface name of the simulated cell; no other value selects it."""
MILLI = 1e-3
"""SI units in one unit of the config, for mm, mm/s and ms."""


def refuse_repeats(values: Iterable[object], what: str) -> None:
    """Raise ValueError if a value occurs twice; ``what`` names the values."""
    listed = list(values)
    if repeated := [value for value in dict.fromkeys(listed) if listed.count(value) > 1]:
        raise ValueError(f"{what} repeat {', '.join(map(str, repeated))}: write another one")


class Section(BaseModel):
    """A part of the config: strict, frozen, finite numbers, no unknown keys."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def kinds(cls) -> list[type["Section"]]:
        """Return the sections that stand for it: itself, or those of plugins."""
        return [cls]

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
    setting = next(field for field in fields(owner) if field.name == name)
    default: Any = setting.default
    kind, limits = number or type(default), setting.metadata

    def in_unit(value: float) -> Any:
        return kind(float(f"{value:.12g}")) if isfinite(value) else None

    key = Field(
        default=in_unit(default / unit),
        ge=in_unit(max(limits["low"] / unit, at_least)),
        gt=in_unit(limits["above"] / unit),
        le=in_unit(min(limits["high"] / unit, at_most)),
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
class Installed:
    """Annotation of a text that names a plugin: ``Annotated[str, Installed(RECOGNIZERS)]``."""

    plugins: Plugins
    """The plugins to choose from."""

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(
        self, _schema: CoreSchema, _handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "enum": list(self.plugins)}

    def _checked(self, name: str) -> str:
        with raised_as(ValueError, ConfigError):
            self.plugins.entry(name)
        return name


def sections_in(annotation: Any) -> list[type[Section]]:
    """Return the sections that a key may hold, through unions, lists, notes and plugins."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation.kinds()
    inner = (section for part in get_args(annotation) for section in sections_in(part))
    return list(dict.fromkeys(inner))
