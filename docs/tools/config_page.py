"""The reference of the config file, made from the model that checks it."""

import enum
import re
import types
import typing
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cell.config.model import CellConfig
from cell.config.section import sections_in


def config_page() -> str:
    """Return a section for each section of the config, an entry for each key.

    A list, not a table: on a narrow screen the meaning would stand outside of it.
    """
    return "\n".join(_sections(CellConfig, ""))


def _sections(model: type[BaseModel], path: str) -> Iterator[str]:
    yield f"## `{path}`\n" if path else "## Top level\n"
    yield f"{_plain(model.__doc__)}\n"
    below = []
    for name, field in model.model_fields.items():
        models = sections_in(field.annotation)
        below += [(inner, _path(path, name, field, inner, models)) for inner in models]
        if name != "kind" and not (models and _default(field) == "see below"):
            yield f"- `{name}`: {_plain(field.description)}\\\n  {_allowed(field)}"
    yield ""
    for inner, inner_path in dict.fromkeys(below):
        yield from _sections(inner, inner_path)


def _path(
    path: str, name: str, field: FieldInfo, inner: type[BaseModel], models: list[type[BaseModel]]
) -> str:
    """Return the dotted path of a section; entries of a list and variants are marked."""
    dotted = f"{path}.{name}" if path else name
    if typing.get_origin(field.annotation) is tuple:
        dotted += "[]"
    kind = inner.model_fields.get("kind")
    if len(set(models)) == 1 or not kind:
        return dotted
    is_default = type(field.get_default(call_default_factory=True)) is inner
    return f"{dotted} ({_choices(kind.annotation)[0]}{', the default' if is_default else ''})"


def _written(annotation: Any) -> str:
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    plain = {float: "number", int: "integer", str: "text", bool: "true or false"}
    named: dict[Any, str] = {typing.Literal: "choice", types.NoneType: "none", **plain}
    if origin is typing.Annotated:
        return _written(inner[0])
    if origin in (types.UnionType, typing.Union):
        return " or ".join(dict.fromkeys(_written(part) for part in inner))
    if origin is tuple:
        number = "list" if Ellipsis in inner else f"{len(inner)}"
        return f"{number} of {_written(inner[0])}"
    return named.get(origin) or named.get(annotation) or "section"


def _choices(annotation: Any) -> list[str]:
    if typing.get_origin(annotation) is typing.Literal:
        return [
            str(value.value if isinstance(value, enum.Enum) else value)
            for value in typing.get_args(annotation)
        ]
    return [choice for inner in typing.get_args(annotation) for choice in _choices(inner)]


def _limits(field: FieldInfo) -> str:
    """Return choices and limits that the text of the key does not state."""
    texts = [f"`{choice}`" for choice in _choices(field.annotation)]
    limits = {
        name: getattr(entry, name)
        for entry in field.metadata
        for name in ("gt", "ge", "lt", "le", "min_length", "max_length")
        if getattr(entry, name, None) is not None
    }
    stated = set(re.findall(r"-?\d+(?:\.\d+)?", field.description or ""))
    for key, sign in (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤")):
        if key in limits:
            limit = f"{limits[key]:{'d' if isinstance(limits[key], int) else 'g'}}"
            texts += [] if limit in stated else [f"{sign} {limit}"]
    if "max_length" in limits:
        unit = "characters" if field.annotation is str else "entries"
        texts.append(f"{limits.get('min_length', 0)} to {limits['max_length']} {unit}")
    elif "min_length" in limits:
        texts.append("not empty")
    return ", ".join(texts)


def _allowed(field: FieldInfo) -> str:
    """Return type, range or choices, and default of a key. The default of a number is its type."""
    default = _default(field)
    default = default if default == "required" else f"default {default}"
    written = _written(field.annotation)
    if written in {"number", "integer", "choice", "true or false"} and default != "required":
        written = ""
    return "; ".join(part for part in (written, _limits(field), default) if part)


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required():
        return "required"
    if isinstance(value, BaseModel):
        return "see below"
    if value is None:
        return "none"
    if isinstance(value, tuple):
        if any(isinstance(entry, BaseModel) for entry in value):
            return f"{len(value)} entries"
        return f"`[{', '.join(map(_scalar, value))}]`"
    return f"`{_scalar(value)}`"


def _scalar(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) or "''"


def _plain(text: str | None) -> str:
    return " ".join((text or "").split())
