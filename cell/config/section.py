"""The base of all sections of the config, and links to settings that are declared elsewhere."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import inf
from typing import Annotated, Any, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    field_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from cell.errors import ConfigError, raised_as
from cell.plugins import Plugins

SIMULATED = "simulated"
"""Port or interface name of the simulated cell; no other value selects it."""
MILLI = 1e-3
"""SI units in one unit of the config, for mm, mm/s and ms."""
_UNITS = {
    "mm_s": "mm/s", "n_s": "N/s", "n_mm": "N/mm", "nm_a": "Nm/A", "mm": "mm", "ms": "ms",
    "deg": "degrees", "hz": "Hz", "n": "N", "s": "s", "a": "A", "c": "°C", "share": "share",
}  # fmt: skip
"""Unit by the end of a key, the longest first."""


def unit_of(key: str) -> str:
    """Return the unit of a key from the end of its name; empty if it has none."""
    return next((unit for end, unit in _UNITS.items() if key.endswith(f"_{end}")), "")


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


@dataclass(frozen=True, slots=True)
class Installed:
    """Annotation of a text that names a plugin: ``Annotated[str, Installed(RECOGNISERS)]``."""

    plugins: Plugins
    """The plugins to choose from."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names that are installed."""
        return tuple(self.plugins)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(
        self, _schema: CoreSchema, _handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "enum": list(self.names)}

    def _checked(self, name: str) -> str:
        with raised_as(ValueError, ConfigError):
            self.plugins.entry(name)
        return name


@dataclass(frozen=True, slots=True)
class SectionOf:
    """Annotation of a section whose ``kind`` names a plugin, which is the section's own class."""

    plugins: Plugins
    """The plugins to choose from."""

    def sections(self) -> list[type[BaseModel]]:
        """Return the sections of the plugins that load."""
        return list(self.plugins.usable().values())

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self._section,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda section, info: section.model_dump(mode=info.mode), info_arg=True
            ),
        )

    def __get_pydantic_json_schema__(
        self, _schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        kinds = [handler(one.__pydantic_core_schema__) for one in self.sections()]
        return {"oneOf": kinds} if kinds else {"type": "object"}

    def _section(self, value: Any, info: core_schema.ValidationInfo) -> BaseModel:
        kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
        if not isinstance(kind, str):
            raise ValueError(f"a section with kind, one of {', '.join(self.plugins)}")
        with raised_as(ValueError, ConfigError):
            section: type[BaseModel] = self.plugins[kind]
        try:
            if info.mode == "json":
                return section.model_validate_json(json.dumps(value))
            return section.model_validate(value)
        except ValidationError as error:
            # As in a union of sections, a place has the kind in it.
            found: list[Any] = [
                {**item, "loc": (kind, *item["loc"])} for item in error.errors(include_url=False)
            ]
            raise ValidationError.from_exception_data(error.title, found) from None


def sections_in(key: FieldInfo) -> Iterator[type[BaseModel]]:
    """Return the sections that a key may hold, through unions, lists, notes and plugins."""
    return _sections_of(
        Annotated[key.annotation, *key.metadata] if key.metadata else key.annotation
    )


def _sections_of(annotation: Any) -> Iterator[type[BaseModel]]:
    inner = get_args(annotation)
    plugins = [
        note for note in getattr(annotation, "__metadata__", ()) if isinstance(note, SectionOf)
    ]
    if plugins:
        yield from plugins[0].sections()
        return
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for one in inner:
        yield from _sections_of(one)
