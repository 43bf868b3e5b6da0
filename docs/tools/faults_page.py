"""The reference of simulated faults, made from the simulator's vocabulary."""

from cell.simulation import fault_table


def faults_page() -> str:
    """Return a table of every fault that can be injected."""
    rows = (
        f"| `{name}` | {kind} | {value or 'none'} | {meaning} |"
        for name, kind, value, meaning in fault_table()
    )
    return "\n".join(("| name | kind | value | what happens |\n| --- | --- | --- | --- |", *rows))
