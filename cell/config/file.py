"""Reading config files: YAML to `CellConfig`; each error names file, line, column and key."""

import difflib
import io
import json
import os
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticUndefined
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, StreamMark, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode

from cell.config.model import CellConfig
from cell.config.section import SIMULATED, Installed, sections_in
from cell.errors import ConfigError
from cell.files import CONFIG, read_plain

_Section = TypeVar("_Section", bound=BaseModel)


def changed_config(config: _Section, changes: Mapping[str, Any]) -> _Section:
    """Return a config, or a section of it, with some values changed.

    ``changes`` has new values by dotted path: ``{"tactile.tare_frames": 25}``. Raises ConfigError
    if a value does not exist, or if the result is not a valid config.
    """
    # Unset values keep their default, which may depend on other keys.
    left = type(config).model_fields.keys() - config.model_fields_set - changes.keys()
    values = {
        name: value
        for name, value in config.model_dump(mode="json").items()
        if name not in left or isinstance(value, dict)
    }
    for path, value in changes.items():
        owner: Any = values
        *way, last = path.split(".")
        for name in way:
            owner = owner.get(name) if isinstance(owner, dict) else None
        if not isinstance(owner, dict) or last not in owner:
            hint = _meant(path.split("."), type(config))
            raise ConfigError(f"the config has no value {path!r}; {hint}")
        owner[last] = deepcopy(value)
    try:
        return type(config).model_validate_json(json.dumps(values, default=os.fspath))
    except TypeError as error:
        raise ConfigError(f"the changed config is not valid: {error}") from error
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, item['loc'])) or 'config'}: {_refusal(item)}"
            for item in error.errors(include_url=False)
        )
        raise ConfigError(f"the changed config is not valid: {problems}") from error


SCHEMA_LINE = "# yaml-language-server: $schema=tactile-cell.schema.json\n"
"""First line of a written config: editors use the schema beside it for completion and checks."""
_COMMENT_WIDTH = 98
"""Characters of a comment line, without indent and number sign."""


SHORT_KEYS = (
    "name", "gripper.port", "gripper.servos", "gripper.linkage", "gripper.aperture_open_mm",
    "gripper.force_max_n", "tactile.interface", "tactile.channel", "tactile.layout",
    "sequence.force_n", "sequence.max_grasps", "sequence.error_rate", "positioner.kind",
    "recording.directory", "serve.listen", "serve.http_port",
)  # fmt: skip
"""Keys that most users set, by dotted path: a short config has these alone."""


def config_text(config: CellConfig, *, comments: bool = True, keys: Sequence[str] = ("",)) -> str:
    """Return a config as YAML that `parse_config` reads back to an equal value.

    With comments the meaning and choices of each key are above it. Keys without a value, and keys
    of other kinds, are comments. ``keys`` are dotted paths: other keys are left out, and read back
    as their defaults.
    """
    lines = _lines(config, "", keys)
    written = lines if comments else _without_comments(lines)
    return SCHEMA_LINE + "".join(f"{line}\n" for line in written)


def _without_comments(lines: Iterator[str]) -> Iterator[str]:
    return (line for line in lines if not line.lstrip().startswith("#"))


def _lines(section: BaseModel, indent: str, keys: Sequence[str] = ("",)) -> Iterator[str]:
    """Return the lines of a section, each key below its comment."""
    for name, key in type(section).model_fields.items():
        # The rest of each path within the key; empty: all of it.
        inner_keys = [
            entry.partition(".")[2] for entry in keys if entry.partition(".")[0] in ("", name)
        ]
        if not inner_keys:
            continue
        value = getattr(section, name)
        yield from _comment(_meaning(key), indent)
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _lines(value, indent + "  ", inner_keys)
        elif isinstance(value, tuple) and any(isinstance(entry, BaseModel) for entry in value):
            yield f"{indent}{name}:"
            for entry in value:
                first, *rest = _without_comments(_lines(entry, ""))
                yield f"{indent}  - {first}"
                yield from (f"{indent}    {line}" for line in rest)
            for inner, inner_key in type(value[0]).model_fields.items():
                if all(getattr(entry, inner) is None for entry in value):
                    yield from _comment(_meaning(inner_key), f"{indent}    ")
                    yield f"{indent}    # {inner}:"
        elif value is not None or key.default is not None:
            yield f"{indent}{name}: {_scalar(value)}"
        else:
            yield f"{indent}# {name}:"
        yield from _alternatives(key, value, indent)


def _comment(text: str, indent: str) -> Iterator[str]:
    start = f"{indent}# "
    yield from textwrap.wrap(text, _COMMENT_WIDTH, initial_indent=start, subsequent_indent=start)


def _meaning(key: FieldInfo) -> str:
    """Return the description of a key, with its choices if it has any."""
    text = " ".join((key.description or "").split())
    kinds = [_kind_of(section) for section in sections_in(key.annotation)]
    choices = kinds if len(kinds) > 1 else _choices(key)
    unnamed = [choice for choice in choices if not re.search(rf"\b{re.escape(choice)}\b", text)]
    return f"{text} One of: {', '.join(choices)}." if unnamed and len(choices) > 1 else text


def _choices(key: FieldInfo) -> list[str]:
    """Return the allowed names or numbers of a key; an empty list if it has a range."""
    if get_origin(key.annotation) is Literal:
        return [str(choice) for choice in get_args(key.annotation)]
    return [name for note in key.metadata if isinstance(note, Installed) for name in note.plugins]


def _alternatives(key: FieldInfo, value: object, indent: str) -> Iterator[str]:
    """Return further possible values of a key as comments: other kinds, or entries of a list."""
    if isinstance(value, tuple) and value:
        return
    entries = get_origin(key.annotation) is tuple
    for kind in sections_in(key.annotation):
        if isinstance(value, kind):
            continue
        yield f"{indent}# {'each entry' if entries else 'or'}:"
        for name, inner in kind.model_fields.items():
            default = inner.default
            if default is PydanticUndefined or sections_in(inner.annotation):
                default = next(iter(_choices(inner)), None)
            yield from _comment(_meaning(inner), f"{indent}#   ")
            yield f"{indent}#   {name}:{'' if default is None else f' {_scalar(default)}'}"
            yield from _alternatives(inner, None, f"{indent}#   ")


def _scalar(value: Any) -> str:
    """Return a plain value, or a list of plain values, as YAML on one line."""
    out = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.width, yaml.default_flow_style = 4096, True
    yaml.dump(value, out)
    return out.getvalue().removesuffix("...\n").rstrip("\n")


class _Constructor(SafeConstructor):
    """Values of a config: a date is a text."""


_Constructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def _read_yaml(text: str, source: str) -> tuple[Node | None, Any]:
    """Return the nodes, which have places, and the values of a text.

    Raises ConfigError with ``source``, line and column if the text is not YAML 1.2.
    """
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = _Constructor
    try:
        return reader.compose(text), reader.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{source}:{_place(mark)}" if mark else source
        raise ConfigError(f"{place}: not YAML 1.2: {error.problem or error.context}") from error
    except (YAMLError, ValueError, RecursionError) as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"{source}: not YAML 1.2: {text}") from error


def _place(mark: StreamMark) -> str:
    """Return line and column, both from 1."""
    return f"{mark.line + 1}:{mark.column + 1}"


MAX_BYTES = 1 << 16
"""Largest config in bytes: YAML in pure Python takes seconds for more."""
_MAX_COMPLAINTS = 20
"""Most errors in one message; further errors are counted."""


def load_config(path: Path | None) -> CellConfig:
    """Read a config file; without a file return the built-in simulated cell.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML 1.2, has unknown or repeated keys, or values out of
        range. One message lists all errors. If it does not name ``gripper.port``: an empty or cut
        file of a real cell must not be taken for the simulated one.
    """
    if path is None:
        return CellConfig()
    data = read_plain(path, error=ConfigError, what="config", limit_bytes=MAX_BYTES)
    try:
        config = parse_config(data.decode("utf-8"), source=str(path))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}:{line}: not UTF-8 text; save the file as UTF-8") from error
    if "port" not in config.gripper.model_fields_set:
        raise ConfigError(
            f"{path}: gripper.port is missing, of which cell is it? Write the servos' serial port, "
            f"or `{SIMULATED}` for the simulated cell; `tactile-cell config init` writes a file"
        )
    return config


def parse_config(text: str, *, source: str) -> CellConfig:
    """Return the checked config of a text; ``source`` names it in errors.

    Raises ConfigError as `load_config`.
    """
    root, data = _read_yaml(text, source)
    if not isinstance(data, dict | None):
        raise ConfigError(f"{source}:1:1: a config is a mapping with sections such as `gripper:`")
    if data and "format" in data:
        CONFIG.check(data["format"], source, ConfigError)
    try:
        return CellConfig.model_validate_json(json.dumps(data or {}))
    except ValidationError as error:
        raise ConfigError(_complaints(error, root, source)) from error
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{source}: a key or value is not plain: {error}; correct it") from error


def recorded_config(text: str) -> CellConfig | None:
    """Return the config in a recording, from JSON; None if it is not valid in this version."""
    try:
        return CellConfig.model_validate_json(text)
    except ValueError:
        return None


def schema_text() -> str:
    """Return the JSON schema of the config file, as text."""
    schema = CellConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "tactile-cell configuration"
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _complaints(error: ValidationError, root: Node | None, source: str) -> str:
    items = error.errors(include_url=False)
    inside = {item["loc"][:n] for item in items for n in range(len(item["loc"]))}
    lines = []
    for item in items:
        if item["loc"] in inside:  # a list whose entries are refused counts as empty, too
            continue
        place, key = _locate(root, _cause(root, item))
        if item["type"] == "extra_forbidden":
            item["msg"] = f"unknown key; {_meant(item['loc'])}"
        lines.append(f"{source}:{place}: {key or 'config'}: {_refusal(item)}")
    more = [f"{source}: {len(lines) - _MAX_COMPLAINTS} more errors"]
    return "\n".join(lines[:_MAX_COMPLAINTS] + more * (len(lines) > _MAX_COMPLAINTS))


def _refusal(item: ErrorDetails) -> str:
    """Return why a value is refused, and the value; a whole section is left out."""
    message, value = item["msg"].removeprefix("Value error, "), item["input"]
    return message if isinstance(value, dict | list) else f"{message} (found: {value!r:.200})"


def _cause(root: Node | None, item: ErrorDetails) -> tuple[int | str, ...]:
    """Return the location of an error. A check of a section names several keys.

    The first of them that the file has is the location. Names are relative to the section, the
    config or the gripper.
    """
    several = isinstance(item["input"], dict)
    for name in re.findall(r"[a-z]+(?:[._][a-z]+)+", item["msg"]) if several else ():
        for section in (item["loc"], (), ("gripper",)):
            path = (*section, *name.split("."))
            if _locate(root, path)[0] != _locate(root, path[:-1])[0]:
                return path
    return item["loc"]


def _meant(loc: Sequence[int | str], config: type[BaseModel] = CellConfig) -> str:
    """Return a hint for an unknown key: a similar key of its section, or all keys of it."""
    *way, unknown = loc
    names = list(_section_at(way, config).model_fields)
    near = difflib.get_close_matches(str(unknown), names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"keys here are {', '.join(names)};"
    return f"{hint} `tactile-cell config init` writes all"


def _section_at(way: Sequence[int | str], section: type[BaseModel]) -> type[BaseModel]:
    """Return the section at a pydantic location; a step into a union is the name of the kind."""
    inner: Sequence[type[BaseModel]] = [section]
    for step in way:
        if step in section.model_fields:
            inner = sections_in(section.model_fields[str(step)].annotation)
        else:
            named = [model for model in inner if step in (model.__name__, _kind_of(model))]
            inner = named or inner
        section = inner[0] if inner else section
    return section


def _kind_of(section: type[BaseModel]) -> str:
    """Return the tag of a section in a union: the value of its ``kind``."""
    kind = section.model_fields.get("kind")
    return str(get_args(kind.annotation)[0]) if kind and get_args(kind.annotation) else "pads"


def _locate(root: Node | None, loc: tuple[int | str, ...]) -> tuple[str, str]:
    """Return place and key of a pydantic location; steps that are not in the file are skipped."""
    node, key = root, []
    place = "1:1" if root is None else _place(root.start_mark)
    for step in loc:
        if isinstance(node, MappingNode):
            entries = [(k, v) for k, v in node.value if k.value == str(step)]
            if entries:
                place, node = _place(entries[0][0].start_mark), entries[0][1]
                key.append(str(step))
            elif step == loc[-1]:
                key.append(str(step))
        elif isinstance(node, SequenceNode) and isinstance(step, int) and step < len(node.value):
            node = node.value[step]
            place = _place(node.start_mark)
            key.append(str(step))
    return place, ".".join(key)
