"""The paper's figures 2, 3, 4 and Table 1 on the simulated cell's physics: a page and its figures.

With full effort it writes out/paper/paper.html, else out/paper-small. Two processes share the
trials; docs/explanations/paper-reproduced.md quotes what this prints.
"""

import multiprocessing
import time
from pathlib import Path

import numpy as np

from benchmarks._measure import line
from benchmarks.paper.claims import claims, share
from benchmarks.paper.level_trials import CONDITIONS
from benchmarks.paper.page import reproduce_paper
from cell.report.paper_table import TABLE_1_LABELS
from recognition.evaluation.metrics import wilson_interval

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
    for title, outcomes in (("any pose", found.tables), ("same touch, new noise", found.repeated)):
        for place, one in outcomes.items():
            condition = CONDITIONS[place]
            at = "own force" if condition.force_n is None else f"{condition.force_n:g} N"
            named = one.windows_named / one.n
            line(
                f"  {title}",
                f"{condition.reading}, {at}, {'filtered' if condition.filtered else 'one frame'}: "
                f"{share(one)} of {one.n}; with windows {100 * named:.0f} % named, "
                f"{100 * one.windows_right / max(1, one.windows_named):.0f} % of those right",
            )
            if condition.filtered and outcomes is found.tables:
                for label, row in zip(TABLE_1_LABELS, one.counts, strict=True):
                    shares = " ".join(f"{100 * n / row.sum():5.1f}" for n in row)
                    line(f"    {label}", shares)
    for point in found.curve:
        parts = [
            f"{100 * one.n_right / one.n:.1f} ({100 * fixed.n_right / fixed.n:.1f})"
            for one, fixed in ((point.adjusted[p], point.fixed[p]) for p in point.adjusted)
        ]
        line(f"  noise {100 * point.noise_share:.0f} %", "  ".join(parts))
    for one in found.contenders:
        right, n = int(np.trace(one.counts)), int(one.counts.sum())
        low, high = wilson_interval(right, n)
        line(
            f"  {one.name}",
            f"{'touch and opening' if one.uses_aperture else 'touch alone'}: "
            f"{100 * right / n:.1f} % ({100 * low:.1f} to {100 * high:.1f}) of {n}, "
            f"unknown {100 * one.rejected / n:.1f} %",
        )
    part = found.invariance[-1]
    line(
        "  ratio",
        "largest over smallest eigenvalue over the printed grid: "
        + ", ".join(f"{float(v.max()):.1f} ({r})" for r, v in part.ratio.items()),
    )
    line("  page", f"{page}, {time.perf_counter() - start_s:.0f} s")


if __name__ == "__main__":
    main()
