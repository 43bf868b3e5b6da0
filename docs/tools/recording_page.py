"""The reference of recordings, made from the schemas that are written into each file."""

from collections.abc import Mapping
from typing import Any

from cell.data.recording_schema import MODELS, json_schema


def recording_page() -> str:
    """Return a table of fields for each topic; fields in bold are always there."""
    return "\n".join(line for topic in MODELS for line in _topic(topic, json_schema(topic)))


def _topic(topic: str, schema: Mapping[str, Any]) -> list[str]:
    rows = [
        f"| {_name(name, name in schema['required'])} | {_type(entry)} "
        f"| {entry.get('description', '')} |"
        for name, entry in schema["properties"].items()
    ]
    return [f"### `{topic}`\n", "| field | type | meaning |\n| --- | --- | --- |", *rows, ""]


def _name(name: str, required: bool) -> str:
    return f"**`{name}`**" if required else f"`{name}`"


def _type(entry: Mapping[str, Any]) -> str:
    return f"array of {_type(entry['items'])}" if entry["type"] == "array" else entry["type"]
