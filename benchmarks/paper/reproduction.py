"""The paper's figures 2, 3, 4 and Table 1 on the simulated cell's physics: a page and its figures.

With full effort it writes out/paper/paper.html and paper.json, which
docs/explanations/paper-reproduced.md quotes, else out/paper-small. Two processes share the trials.
"""

import multiprocessing
import time
from pathlib import Path

from benchmarks._measure import line
from benchmarks.paper.claims import claims
from benchmarks.paper.page import reproduce_paper

_WORKERS = 2


def main(effort: float = 1.0) -> None:
    start_s = time.perf_counter()
    full = effort >= 1.0
    folder = Path("out", "paper" if full else "paper-small")
    found, page = reproduce_paper(
        folder,
        effort=effort,
        workers=min(_WORKERS, multiprocessing.cpu_count()) if full else 1,
    )
    trials = sum(one.n for one in found.tables.values()) // len(found.tables)
    line("compared", f"the paper with {trials} simulated trials of its Table 1")
    for claim in claims(found):
        line(f"  {claim.where}", f"{claim.verdict}: {claim.claim} | {claim.found}")
    line("  page", f"{page}, {time.perf_counter() - start_s:.0f} s")
