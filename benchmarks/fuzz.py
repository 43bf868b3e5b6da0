"""Bad input for every parser: python -m benchmarks.fuzz [--count N] [--seconds S] [TARGET ...].

Each target runs in a process of its own, with its own limits of time and memory. The command ends
with an error where an invariant was broken, and prints the inputs that did it.
"""

import argparse
import logging
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

from benchmarks import (
    _fuzz_archives,
    _fuzz_can,
    _fuzz_recording,
    _fuzz_servo,
    _fuzz_slcan,
    _fuzz_text,
)
from benchmarks._fuzz_engine import Result, Target, run

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (
        _fuzz_servo,
        _fuzz_can,
        _fuzz_slcan,
        _fuzz_archives,
        _fuzz_recording,
        _fuzz_text,
    )
    for target in module.TARGETS
}


def fuzz(name: str, count: int, seconds: float, seed: int) -> Result:
    """Run one target in this process; what libraries log of each damage is not shown."""
    logging.disable(logging.CRITICAL)
    return run(TARGETS[name], count=count, seconds=seconds, seed=seed)


def table(results: Sequence[Result]) -> str:
    """Return the results as a table in Markdown."""
    lines = [
        "| target | parser | inputs tried | inputs | per second | slowest | outcome | defects |",
        "|---|---|---|--:|--:|--:|---|--:|",
    ]
    for result in results:
        target = TARGETS[result.name]
        outcomes = "; ".join(f"{text} {n:,}" for text, n in result.outcomes.most_common())
        speed = result.inputs / result.wall_s if result.wall_s else 0.0
        lines.append(
            f"| {result.name} | {target.parser} | {target.inputs} | {result.inputs:,} | "
            f"{speed:,.0f} | {1e3 * result.slowest_s:.0f} ms | {outcomes} | {result.n_failures} |"
        )
    total = sum(result.inputs for result in results)
    return "\n".join([*lines, "", f"{total:,} inputs in all."])


def _results(
    names: Sequence[str], count: int, seconds: float, seed: int, jobs: int
) -> list[Result]:
    """Run each target in a fresh process, so that one's memory is not the other's."""
    with ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        results = []
        for future in [pool.submit(fuzz, name, count, seconds, seed) for name in names]:
            results.append(future.result())
            print(f"{results[-1].name}: {results[-1].inputs:,} inputs", file=sys.stderr, flush=True)
    return results


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=", ".join(TARGETS))
    parser.add_argument("--count", type=int, default=2000, help="inputs for each target")
    parser.add_argument("--seconds", type=float, default=1e9, help="longest time for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args(arguments)
    unknown = [name for name in given.targets if name not in TARGETS]
    if unknown:
        parser.error(f"unknown target {unknown[0]}; there are {', '.join(TARGETS)}")
    names = given.targets or list(TARGETS)
    results = _results(names, given.count, given.seconds, given.seed, given.jobs)
    print(table(results))
    for result in results:
        for text in result.failures:
            print(f"\nDEFECT in {result.name}: {text}")
    return 1 if any(result.n_failures for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
