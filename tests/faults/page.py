"""The page of the campaign in Markdown, and the part of the docs that the table gives."""

from collections import Counter
from collections.abc import Sequence

from tests.faults.campaign import FaultRow, Observed
from tests.faults.results import AS_REQUIRED, Result
from tests.faults.table import GROUPS, REACTIONS, ROWS

BEGIN, END = (
    "<!-- made by `python -m tests.faults --summary`: begin -->",
    "<!-- end of what is made -->",
)
_HEAD = """# Fault campaign

Made by `python -m tests.faults`. Each fault is brought about on the simulated cell while it does
its job; what the cell did about it is compared with what it has to do. While a row runs, the
invariants of docs/reference/fault-campaign.md hold, or the row is broken.

"""


def page(results: Sequence[Result]) -> str:
    """Return the page: totals, reactions, one line for each row."""
    return f"{_HEAD}{totals(results)}\n\n{_reactions()}\n## Rows\n\n{rows_table(results)}"


def totals(results: Sequence[Result]) -> str:
    """Return one line: how many faults, how many reactions as required."""
    good = sum(result.verdict == AS_REQUIRED for result in results)
    kinds = {result.row.row for result in results}
    return (
        f"{len(results)} variants of {len(kinds)} of the 44 kinds of fault: {good} with the "
        f"required reaction within their limit, {len(results) - good} not."
    )


def rows_table(results: Sequence[Result]) -> str:
    lines = []
    for result in results:
        row, observed = result.row, result.observed or Observed("", None, "")
        variant = f" ({row.variant})" if row.variant else ""
        lines.append(
            (
                str(row.row),
                f"{row.fault}{variant}",
                f"`{row.injected}`",
                row.reaction,
                _time(row.limit_s),
                _time(observed.detected_after_s),
                observed.outcome,
                result.verdict,
            )
        )
    heads = ("row", "fault", "injected", "reaction", "limit", "detected after", "outcome", "")
    return _table(heads, lines, right=(0, 4, 5))


def summary() -> str:
    """Return the part of docs/reference/fault-campaign.md that is made from the table."""
    kinds = {row.row for row in ROWS}
    lines = [
        (name, _ranges({row.row for row in rows}), str(len(rows)), _counted(rows))
        for name, rows in GROUPS.items()
    ]
    heads = ("what fails", "kinds", "variants", "required reactions")
    return (
        f"{BEGIN}\n{len(ROWS)} variants of {len(kinds)} kinds of fault, "
        f"{sum(row.real_time for row in ROWS)} of them between real processes in real time, "
        f"{sum(row.limit_s is not None for row in ROWS)} with a limit for the time until the fault "
        f"is detected. `make campaign` runs all of them, `make test` one of each kind; both run "
        f"random commands and faults.\n\n{_table(heads, lines, right=(2,))}\n{_reactions()}{END}\n"
    )


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


def _reactions() -> str:
    return _table(("reaction", "meaning"), list(REACTIONS.items()))


def _table(
    heads: Sequence[str], lines: Sequence[Sequence[str]], *, right: Sequence[int] = ()
) -> str:
    rule = ["--:" if place in right else "---" for place in range(len(heads))]
    table = [heads, *([_cell(text) for text in line] for line in lines)]
    rows = [f"| {' | '.join(line)} |" for line in table]
    return "\n".join((rows[0], f"|{'|'.join(rule)}|", *rows[1:])) + "\n"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "/").split())


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1e3 * seconds:.0f} ms" if seconds < 1.0 else f"{seconds:.2f} s"
