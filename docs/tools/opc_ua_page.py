"""The table of the OPC UA variables, made from the variables themselves."""

from cell.interfaces.opc_ua.door import ARRAYS, PLATE, VALUES


def opc_ua_page() -> str:
    """Return one row for each variable."""
    rows = ["| variable | type | |", "| --- | --- | --- |"]
    for value in (*PLATE, *VALUES):
        array = "[]" if value.path in ARRAYS else ""
        rows.append(f"| `{value.path}` | {value.type.name}{array} | {value.text} |")
    return "\n".join(rows)
