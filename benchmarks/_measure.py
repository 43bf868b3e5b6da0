"""Shared helpers: work in a process of its own, shares with intervals, effort, lines of figures."""

import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from joblib.externals.loky import get_reusable_executor

from recognition.evaluation.evaluation import wilson_interval

_Result = TypeVar("_Result")


def in_own_process(work: Callable[[], _Result]) -> tuple[_Result, float, list[float]]:
    """Do the work in a process of its own.

    Returns the result, seconds, and peak memory of that process and of its largest worker in GB.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as child:
        return child.submit(_watched, work).result()


def _watched(work: Callable[[], _Result]) -> tuple[_Result, float, list[float]]:
    began_s = time.perf_counter()
    result = work()
    took_s = time.perf_counter() - began_s
    get_reusable_executor().shutdown(wait=True)
    who = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return result, took_s, [resource.getrusage(one).ru_maxrss * 1024e-9 for one in who]


def share(n_hits: int, n: int, interval: tuple[float, float] | None = None) -> str:
    """Return a share in per cent as text with its 95 % interval, without one with Wilson's."""
    low, high = interval or wilson_interval(n_hits, n)
    return f"{100 * n_hits / max(1, n):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def repeats(full: int, effort: float, *, least: int = 1) -> int:
    """Return the number of repeats at the present effort: ``full`` at effort 1."""
    return max(least, round(full * effort))


def same(holds: bool, what: str) -> None:
    """End the benchmark if two alternatives have different results."""
    if not holds:
        raise SystemExit(f"the figures mean nothing: {what}")


def line(name: str, text: str) -> None:
    """Print one line of figures."""
    print(f"{name:<26} {text}", flush=True)
