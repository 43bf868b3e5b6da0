"""The reference of simulated faults, made from the simulator's vocabulary."""

from simulator.faults.vocabulary import VOCABULARY, FaultEntry, Number


def faults_page() -> str:
    """Return a table of every fault that can be injected: name, value by default, effect."""
    rows = (
        f"| `{entry.name}`{' *' if entry.moment else ''} | {_value(entry)} | {entry.meaning} |"
        for entry in VOCABULARY.values()
    )
    return "\n".join(("| name | value | what happens |\n| --- | --- | --- |", *rows))


def _value(entry: FaultEntry) -> str:
    if isinstance(entry.value, Number):
        return f"{entry.value.default:g} {entry.value.unit}"
    return entry.value.text.replace(", default ", " ") if entry.value else ""
