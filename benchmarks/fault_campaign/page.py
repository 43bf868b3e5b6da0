"""docs/fault-campaign.md: run every row and write what was seen."""

import logging
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.fault_campaign.machine import Outcome, run_all
from benchmarks.fault_campaign.row import Observed
from benchmarks.fault_campaign.rows import ROWS
from benchmarks.fault_campaign.table import (
    AS_REQUIRED,
    Result,
    rows_table,
    run_row,
    totals,
    vocabulary_table,
)

PAGE = Path(__file__).parents[2] / "docs" / "fault-campaign.md"
FIRST_SEED = 101
"""Other seeds than those of the tests: what they have seen need not be seen again."""
BEGIN, END = "<!-- vocabulary: begin -->", "<!-- vocabulary: end -->"

_HEAD = """# Fault campaign

Written by `python -m benchmarks fault_campaign`. Each fault is brought about on the simulated cell
while it does its job; what the cell did about it is compared with what it has to do. While a row
runs, these hold or the row is broken: the force on a pad stays below the cap, no part is let go
without being asked, no torque comes on after a fault without a reset, every command ends in time.

"""
_REACTIONS = """
| reaction | meaning |
|---|---|
| REJECT | the start is refused, cause and remedy are named |
| NOTE | counted and kept in the record; the job goes on |
| HOLD | the ramp stops, goals stay at their last values, the grip is kept; clear and reset needed |
| LIMP | torque off: position or force of the fingers is not known, or the force is over the cap |
| ABORT | as HOLD, and a servo has lost its torque by itself: the part is possibly dropped |
| NO PART FOUND, PART LOST | the fingers stop and open again, nothing is learnt or classified |
| UNKNOWN | the job ends with the answer unknown, never with a label |
"""


def vocabulary_section() -> str:
    """Return the part of the page that is made from the vocabulary alone."""
    return f"""{BEGIN}
## Faults by name

`COMPONENT.FAULT[=VALUE][@START[..END]]`, as `can.loss=0.05@2s`, `servo1.reboot@contact+0.5s` or
`unit.off@moving..3s`. Times count from the injection; `contact` is the first time after it that
both pads touch the object, `moving` that a finger moves. Without an end a fault lasts until it is
cleared. `servoN` is `servo1`, `servo2`: their order in the config.

- Command line: `tactile-cell simulate --fault can.loss=0.05@2s`, `tactile-cell run --fault ...`,
  repeatable; `tactile-cell simulate --list-faults` prints this table.
- Config: `simulator.faults`, a list of such texts.
- Python: `SimulatedCell.inject("can.loss=0.05@2s")`, `.clear()` on what it returns.
- Socket of a running `simulate`: `{{"inject": "can.off"}}`, `{{"clear": "can.off"}}`.

They exist in the simulator only: with real ports in the config a fault is refused.

{vocabulary_table()}
{END}
"""


def page(results: Sequence[Result], machine: str) -> str:
    """Return the page in Markdown."""
    return (
        f"{_HEAD}{totals(results)}\n\n{machine}\n{_REACTIONS}\n## Rows\n\n"
        f"{rows_table(results)}\n\n{vocabulary_section()}"
    )


def machine_text(outcome: Outcome) -> str:
    """Return what a run of the state machine has found, as a sentence or two."""
    found = "no invariant was broken" if not outcome.defect else "**an invariant was broken**"
    return (
        f"Random commands and faults (`benchmarks/fault_campaign/machine.py`): {outcome.steps:,} "
        f"steps in this run, after each of which all invariants were checked: {found}. Continuous "
        "integration runs 10,000 steps, `make campaign` a million."
    )


def run_rows(*, jobs: int) -> list[Result]:
    """Run all rows: those in real time one after the other, the rest on several processes."""
    found: dict[str, Result] = {}

    def tell(result: Result) -> None:
        found[result.row.name] = result
        print(f"{result.row.name}: {result.verdict} ({result.seconds:.1f} s)", flush=True)

    for row in ROWS:
        if row.real_time:
            tell(run_row(row))
    others = [row for row in ROWS if not row.real_time]
    if len(others) <= jobs:
        for row in others:
            tell(run_row(row))
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            for row, seen in zip(others, pool.map(_seen, range(len(others))), strict=True):
                tell(Result(row=row, observed=seen[0], failure=seen[1], seconds=seen[2]))
    return [found[row.name] for row in ROWS]


def _seen(number: int) -> tuple[Observed | None, str, float]:
    """Run one of the rows in virtual time; what is returned passes between processes."""
    logging.disable(logging.CRITICAL)
    row = [row for row in ROWS if not row.real_time][number]
    result = run_row(row)
    return result.observed, result.failure, result.seconds


def update_vocabulary() -> None:
    """Write the vocabulary anew into the page, and leave the rest of it as it is."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2].lstrip("\n")
    PAGE.write_text(before + vocabulary_section() + after, encoding="utf-8")


def main() -> None:
    """Run the rows and the state machine; STATE_STEPS and STATE_SECONDS bound the latter."""
    steps = int(os.environ.get("STATE_STEPS", "10000"))
    seconds = float(os.environ.get("STATE_SECONDS", "1e9"))
    logging.disable(logging.CRITICAL)
    results = run_rows(jobs=os.cpu_count() or 1)
    print(totals(results), flush=True)
    outcome = run_all(
        steps,
        first_seed=FIRST_SEED,
        jobs=os.cpu_count() or 1,
        seconds=seconds,
        progress=lambda text: print(text, flush=True),
    )
    print(f"state machine: {outcome.steps:,} steps in {outcome.seconds:.0f} s", flush=True)
    PAGE.write_text(page(results, machine_text(outcome)), encoding="utf-8")
    print(f"written: {PAGE}")
    if outcome.defect:
        sys.exit(f"DEFECT\n{outcome.defect}")
    wrong = [result.row.name for result in results if result.verdict != AS_REQUIRED]
    if wrong:
        sys.exit(f"not as required: {', '.join(wrong)}")


if __name__ == "__main__":
    update_vocabulary()
