"""Writing a config as YAML, each key under a comment that says what it means."""

import io
from typing import Any

from pydantic import BaseModel
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from cell.config import CellConfig

SCHEMA_LINE = "# yaml-language-server: $schema=tactile-cell.schema.json\n"
"""First line of every config file: editors complete and check against the schema beside it."""


def write_yaml(config: CellConfig, *, comments: bool) -> str:
    """Return the config as YAML text; `cell.config_file.parse_config` reads an equal value back."""
    yaml = YAML()
    yaml.width = 100
    yaml.indent(mapping=2, sequence=4, offset=2)
    out = io.StringIO()
    yaml.dump(_mapping(config, 0, comments), out)
    return SCHEMA_LINE + out.getvalue()


def _mapping(model: BaseModel, indent: int, comments: bool) -> CommentedMap:
    result = CommentedMap()
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if value is None:
            continue
        result[name] = _value(value, indent + 2, comments)
        if comments and field.description:
            text = " ".join(field.description.split())
            result.yaml_set_comment_before_after_key(name, before=text, indent=indent)
    return result


def _value(value: Any, indent: int, comments: bool) -> Any:
    if isinstance(value, BaseModel):
        return _mapping(value, indent, comments)
    if isinstance(value, tuple):
        models = any(isinstance(entry, BaseModel) for entry in value)
        sequence = CommentedSeq(_value(entry, indent + 4, comments=False) for entry in value)
        if not models:
            sequence.fa.set_flow_style()
        return sequence
    return value
