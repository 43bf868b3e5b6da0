"""The tables of the fault numbers, made from the fault catalogue."""

from collections import Counter

from cell.fault_catalogue import APART, AXES_STOP, CATALOGUE, HELD, UNMOVED

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

_GRIPS = {HELD: "kept", UNMOVED: "unmoved", AXES_STOP: "axes stop", APART: "unaffected"}
"""Short words for what most faults do to the grip."""


def catalogue_page() -> str:
    """Return the ways back, then one table for each hundred of numbers."""
    often = Counter(fault.steps for fault in CATALOGUE.values()).most_common()
    ways = {steps: chr(ord("A") + place) for place, (steps, _) in enumerate(often)}
    parts = ["| way | steps |\n|---|---|"]
    parts += [f"| {letter} | {', '.join(steps)} |" for steps, letter in ways.items()]
    parts += [f"\n| grip | meaning |\n|---|---|\n{_lines(_GRIPS)}\n"]
    for hundred, heading in _CHAPTERS.items():
        rows = [
            f"| {fault.number} | {fault.text}<br>`{kind.__name__}` | {fault.cause} | "
            f"{fault.remedy} | {ways[fault.steps]}: {_GRIPS.get(fault.grip, fault.grip)} |"
            for kind, fault in sorted(CATALOGUE.items(), key=lambda entry: entry[1].number)
            if fault.number // 100 == hundred
        ]
        if rows:
            head = "| number | text, error class | usual cause | remedy | way: grip |"
            parts += [f"### {hundred}xx: {heading}\n", head, "|---|---|---|---|---|", *rows, ""]
    return "\n".join(parts)


def _lines(words: dict[str, str]) -> str:
    return "\n".join(f"| {short} | {text} |" for text, short in words.items())
