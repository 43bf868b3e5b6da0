"""The reference of recordings, made from the schemas that are written into each file."""

from collections.abc import Mapping
from typing import Any

from cell.recording.schema import MODELS, json_schema


def recording_page() -> str:
    """Return a table of fields for each topic; each file has the types."""
    return "\n".join(line for topic in MODELS for line in _topic(topic, json_schema(topic)))


def _topic(topic: str, schema: Mapping[str, Any]) -> list[str]:
    rows = [
        f"| `{name}`{'' if name in schema['required'] else ' *'} | {entry.get('description', '')} |"
        for name, entry in schema["properties"].items()
    ]
    return [f"### `{topic}`\n", "| field | meaning |\n| --- | --- |", *rows, ""]
