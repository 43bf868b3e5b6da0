"""Reading config files: YAML to `CellConfig`, every complaint with file, line, column and key."""

import difflib
import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, StreamMark, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode
from ruamel.yaml.reader import ReaderError

from cell.config import CellConfig
from cell.errors import ConfigError

MAX_BYTES = 1 << 16
"""Largest config that is read: YAML in pure Python takes seconds for more."""
_MAX_DEPTH = 20
_MAX_BRACKETS = 100
_MAX_VALUES = 4000
_MAX_COMPLAINTS = 20


def load_config(path: Path | None) -> CellConfig:
    """Read a config file; without one, return the built-in simulated cell.

    Raises
    ------
    ConfigError
        If the file cannot be read, is cut off within its last line, is not YAML 1.2, has unknown
        or repeated keys, aliases, or values out of range. All complaints stand in one message.
    """
    if path is None:
        return CellConfig()
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ConfigError(f"{path}: {size} bytes; a config has at most {MAX_BYTES}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    if text and not text.endswith("\n"):
        line, column = text.count("\n") + 1, len(text) - text.rfind("\n")
        raise ConfigError(
            f"{path}:{line}:{column}: the last line does not end, the file may be cut off; "
            "complete it and end it with a line break"
        )
    return parse_config(text, source=str(path))


def parse_config(text: str, *, source: str) -> CellConfig:
    """Check the text of a config; ``source`` names it in complaints.

    Raises
    ------
    ConfigError
        As `load_config`.
    """
    if len(text) > MAX_BYTES:
        raise ConfigError(f"{source}: {len(text)} characters; a config has at most {MAX_BYTES}")
    _refuse_brackets(text, source)
    try:
        root = YAML(typ="safe", pure=True).compose(text)
        if root is not None:
            _refuse_bombs(root, source)
        data = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(_not_yaml(error, text, source)) from error
    if data is None:
        data = {}
    if not isinstance(data, dict):
        kind = type(data).__name__
        raise ConfigError(f"{source}:1:1: a config is a mapping of sections, not a {kind}")
    try:
        return CellConfig.model_validate_json(json.dumps(data, default=str))
    except TypeError as error:
        raise ConfigError(f"{source}: a key that is no plain text: {error}") from error
    except ValidationError as error:
        raise ConfigError(_complaints(error, root, source)) from error


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of the config file."""
    schema = CellConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "tactile-cell configuration"
    return schema


def schema_text() -> str:
    """Return the JSON schema as the text that is committed in config/."""
    return json.dumps(config_schema(), indent=2, ensure_ascii=False) + "\n"


def config_text(config: CellConfig, *, comments: bool = True) -> str:
    """Write a config as YAML that `parse_config` reads back to an equal value."""
    from cell.config_writer import write_yaml  # noqa: PLC0415  only `config init` needs it

    return write_yaml(config, comments=comments)


def _not_yaml(error: Exception, text: str, source: str) -> str:
    if isinstance(error, MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        said = ": ".join(str(part) for part in (error.context, error.problem) if part)
        return f"{source}:{_place(mark)}: not YAML 1.2: {said}" if mark else f"{source}: {said}"
    if isinstance(error, ReaderError):
        before = text[: error.position]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        return f"{source}:{line}:{column}: not YAML 1.2: a character that must not stand in a text"
    return f"{source}: not YAML 1.2: {error}"


def _place(mark: StreamMark) -> str:
    return f"{mark.line + 1}:{mark.column + 1}"


def _refuse_brackets(text: str, source: str) -> None:
    """Refuse brackets nested so deep that the YAML library would take seconds to give up."""
    depth = 0
    for line, content in enumerate(text.splitlines(), start=1):
        for column, sign in enumerate(content, start=1):
            depth += (sign in "[{") - (sign in "]}")
            if depth > _MAX_BRACKETS:
                raise ConfigError(
                    f"{source}:{line}:{column}: more than {_MAX_BRACKETS} open brackets"
                )


def _refuse_bombs(root: Node, source: str) -> None:
    seen: set[int] = set()
    stack = [(root, 1)]
    while stack:
        node, depth = stack.pop()
        if id(node) in seen:
            raise ConfigError(
                f"{source}:{_place(node.start_mark)}: aliases are not allowed; write the value out"
            )
        seen.add(id(node))
        if depth > _MAX_DEPTH or len(seen) > _MAX_VALUES:
            raise ConfigError(
                f"{source}:{_place(node.start_mark)}: more than {_MAX_DEPTH} levels or "
                f"{_MAX_VALUES} values; not a config"
            )
        if isinstance(node, MappingNode):
            stack += [(part, depth + 1) for pair in node.value for part in pair]
        elif isinstance(node, SequenceNode):
            stack += [(part, depth + 1) for part in node.value]


def _complaints(error: ValidationError, root: Node | None, source: str) -> str:
    lines = []
    found = error.errors(include_url=False)
    for item in found[:_MAX_COMPLAINTS]:
        place, key = _locate(root, item["loc"])
        given = item.get("input")
        shown = "" if isinstance(given, dict | list) else f" (found: {given!r})"
        message = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden":
            message = f"unknown key; {_meant(key)}`tactile-cell config schema` lists the keys"
        lines.append(f"{source}:{place}: {key or 'config'}: {message}{shown}")
    if len(found) > len(lines):
        lines.append(f"{source}: {len(found) - len(lines)} more complaints")
    return "\n".join(lines)


def _meant(key: str) -> str:
    """Name the known key that an unknown one resembles; empty without one."""
    schema = CellConfig.model_json_schema()
    sections = [schema, *schema["$defs"].values()]
    names = sorted({name for section in sections for name in section.get("properties", ())})
    near = difflib.get_close_matches(key.rpartition(".")[2], names, n=1)
    return f"is {near[0]} meant? " if near else ""


def _locate(root: Node | None, loc: tuple[int | str, ...]) -> tuple[str, str]:
    """Follow a pydantic location as far as the file goes; steps that name a union are not in it."""
    node, key = root, []
    place = "1:1" if root is None else _place(root.start_mark)
    for step in loc:
        if isinstance(node, MappingNode):
            found = [(k, v) for k, v in node.value if k.value == str(step)]
            if found:
                place, node = _place(found[0][0].start_mark), found[0][1]
                key.append(str(step))
            elif step == loc[-1]:
                key.append(str(step))
        elif isinstance(node, SequenceNode) and isinstance(step, int) and step < len(node.value):
            node = node.value[step]
            place = _place(node.start_mark)
            key.append(str(step))
    return place, ".".join(key)
