"""Work spread over the cores of this machine, with joblib."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

import joblib

from cell.errors import CellError
from recognition.evaluation.evaluation import Mapper, one_by_one

_MOST_DEATHS = 3
"""How often a process may end before any work is done."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def spread(work: Callable[[_Item], _Result], items: Sequence[_Item], /) -> Iterable[_Result]:
    """Do the work through joblib, by the backend of the surrounding `workers`; a `Mapper`.

    Results come as they are done, in order. Work that a worker held when it died is done again;
    raises CellError where workers die again and again.
    """
    n_done = deaths = 0
    while n_done < len(items):
        left = items[n_done:]
        try:
            for result in joblib.Parallel(return_as="generator")(
                joblib.delayed(work)(item) for item in left
            ):
                n_done, deaths = n_done + 1, 0
                yield result
        except BrokenProcessPool as error:
            deaths += 1
            if deaths == _MOST_DEATHS:
                raise CellError(
                    f"{deaths} processes ended at the same work, probably by lack of memory: use "
                    "fewer --jobs; finished work is kept"
                ) from error


@contextmanager
def workers(jobs: int = 1) -> Iterator[Mapper]:
    """Yield what does work for many items: in this process, or in ``jobs`` processes.

    ``jobs`` is 1 for no process but this one, 0 for one a core. Raises CellError if it is negative.
    """
    if jobs < 0:
        raise CellError(f"--jobs is {jobs}; 0 is one process per core, 1 is this process alone")
    if jobs == 1:
        yield one_by_one
        return
    with joblib.parallel_config("loky", n_jobs=jobs or -1, inner_max_num_threads=1):
        yield spread
