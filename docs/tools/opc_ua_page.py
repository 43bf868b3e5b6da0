"""The table of the OPC UA variables, made from the variables themselves."""

from cell.interfaces.opc_ua.interface import ARRAYS, NODES


def opc_ua_page() -> str:
    """Return one row for each variable."""
    rows = ["| variable | type | |", "| --- | --- | --- |"]
    for path, (kind, text) in NODES.items():
        rows.append(f"| `{path}` | {kind.name}{'[]' if path in ARRAYS else ''} | {text} |")
    return "\n".join(rows)
