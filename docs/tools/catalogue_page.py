"""The table of the fault numbers, made from the fault catalogue."""

from cell.fault_catalogue import CATALOGUE

_CHAPTERS = {
    1: "Servos and servo line",
    2: "Grip and force",
    3: "CAN and control unit",
    4: "Taxels and frames",
    5: "Cell, job and host",
    6: "Axes and wrist",
    7: "Recognition and models",
}
"""Heading of each hundred."""


def catalogue_page() -> str:
    """Return one table for each hundred of numbers."""
    parts: list[str] = []
    for hundred, heading in _CHAPTERS.items():
        rows = [
            f"| {fault.number} | {fault.text}<br>`{kind.__name__}` | {fault.cause} | "
            f"{fault.remedy} | {', '.join(fault.steps)} | {fault.grip} |"
            for kind, fault in sorted(CATALOGUE.items(), key=lambda entry: entry[1].number)
            if fault.number // 100 == hundred
        ]
        if rows:
            head = "| number | text, error class | usual cause | remedy | steps | grip |"
            parts += [f"## {hundred}xx: {heading}\n", head, "|---|---|---|---|---|---|", *rows, ""]
    return "\n".join(parts)
