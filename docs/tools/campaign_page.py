"""The figures of the fault campaign, made from its table of rows."""

from collections import Counter
from collections.abc import Sequence

from tests.faults.campaign import FaultRow
from tests.faults.table import EACH_CHANGE, GROUPS, REACTIONS, ROWS


def campaign_page() -> str:
    """Return how many rows there are, by what fails and by the required reaction."""
    lines = [
        f"There are {len(ROWS)} variants of {len({row.row for row in ROWS})} kinds of fault. Of "
        f"these {sum(row.real_time for row in ROWS)} run between real processes in real time, and "
        f"{sum(row.limit_s is not None for row in ROWS)} have a time limit for the detection. "
        "`make campaign` runs all of them, `make test` "
        f"{len(EACH_CHANGE)}; both run random "
        "commands and faults. After each fault of a grasp the steps of the "
        "[fault catalogue](../reference/faults.md#fault-numbers) lead back to IDLE.\n",
        "| what fails | kinds | variants | required reactions |\n|---|---|--:|---|",
        *(
            f"| {name} | {_ranges({row.row for row in rows})} | {len(rows)} | {_counted(rows)} |"
            for name, rows in GROUPS.items()
        ),
    ]
    return "\n".join(lines)


def reactions_page() -> str:
    """Return what each required reaction means."""
    rows = (f"| {name} | {meaning} |" for name, meaning in REACTIONS.items())
    return "\n".join(("| reaction | meaning |\n|---|---|", *rows))


def _counted(rows: Sequence[FaultRow]) -> str:
    numbers = Counter(row.reaction for row in rows)
    return ", ".join(f"{numbers[name]} {name}" for name in REACTIONS if numbers[name])


def _ranges(numbers: set[int]) -> str:
    """Return numbers as ``22 to 27, 30``."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
