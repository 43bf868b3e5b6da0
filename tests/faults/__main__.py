"""Run every row and write the page: ``python -m tests.faults``."""

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.faults import page, table
from tests.faults.results import AS_REQUIRED, Result, run_rows

ROOT = Path(__file__).parents[2]
SUMMARY = ROOT / "docs" / "reference" / "fault-campaign.md"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the campaign; exits with a message where anything is not as required."""
    given = _parser().parse_args(arguments)
    if given.summary:
        update_summary()
        return
    results = run_rows(table.ROWS, jobs=given.jobs, progress=_print)
    print(page.totals(results), flush=True)
    given.page.parent.mkdir(parents=True, exist_ok=True)
    given.page.write_text(page.page(results), encoding="utf-8")
    print(f"written: {given.page}")
    wrong = [result.row.name for result in results if result.verdict != AS_REQUIRED]
    if wrong:
        sys.exit(f"not as required: {', '.join(wrong)}")


def _print(result: Result) -> None:
    print(f"{result.row.name}: {result.verdict} ({result.seconds:.1f} s)", flush=True)


def update_summary() -> None:
    """Write the part of the summary that the table gives, and leave the rest of it as it is."""
    before, _, rest = SUMMARY.read_text(encoding="utf-8").partition(page.BEGIN)
    after = rest.partition(page.END)[2].lstrip("\n")
    SUMMARY.write_text(before + page.summary() + "\n" + after, encoding="utf-8")
    print(f"written: {SUMMARY}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--page", type=Path, default=ROOT / "out" / "fault-campaign.md")
    parser.add_argument("--summary", action="store_true", help=f"only update {SUMMARY.name}")
    return parser


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    main()
