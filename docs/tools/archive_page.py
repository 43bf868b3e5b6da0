"""The reference of archives, made from the columns of their table."""

from cell.archive.store import COLUMNS


def archive_page() -> str:
    """Return one row for each column; each file has the types."""
    rows = (f"| `{name}` | {text} |" for name, text in COLUMNS.items())
    return "\n".join(("| column | meaning |", "| --- | --- |", *rows))
