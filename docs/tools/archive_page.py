"""The reference of archives, made from the columns of their table."""

from cell.archive.table import COLUMNS, SCHEMA


def archive_page() -> str:
    """Return one row for each column."""
    rows = ["| column | type | meaning |", "| --- | --- | --- |"]
    for name, text in COLUMNS.items():
        rows.append(f"| `{name}` | `{SCHEMA.field(name).type}` | {text} |")
    return "\n".join(rows)
