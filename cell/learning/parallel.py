"""Long work: its progress, its spread over the cores with joblib, one thread of BLAS.

The matrices of the linear algebra library (BLAS) are small here: more threads gain nothing, and
OpenBLAS lets them spin, which delays the force loop and the host's own threads.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

import joblib
from threadpoolctl import threadpool_limits

from cell.errors import CellError
from recognition.evaluation.evaluation import Mapper, one_by_one

Progress = Callable[[str, int, int], None]
"""Called after each step with a task, its finished steps, and all steps; the command line draws a
bar from it."""


def silent(task: str, done: int, total: int) -> None:
    """Show no progress."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within the block, then restore its limit.

    Also a decorator. BLAS has one limit for the whole process: a limit that another thread sets by
    threadpoolctl meanwhile stays.
    """
    # Searched each time: numpy and scipy each have a library, and scipy's is loaded later.
    with threadpool_limits(limits=1, user_api="blas"):
        yield


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def spread(work: Callable[[_Item], _Result], items: Sequence[_Item], /) -> Iterable[_Result]:
    """Do the work through joblib, by the backend of the surrounding `workers`; a `Mapper`.

    Results come as they are done, in order. Raises CellError where a process ends at its work.
    """
    tasks = (joblib.delayed(work)(item) for item in items)
    try:
        yield from joblib.Parallel(return_as="generator")(tasks)
    except BrokenProcessPool as error:
        raise CellError(
            "a process ended at its work, probably by lack of memory: use fewer grasps or --jobs"
        ) from error


@contextmanager
def workers(jobs: int = 1) -> Iterator[Mapper]:
    """Yield what does work for many items: in this process, or in ``jobs`` processes.

    ``jobs`` is 1 for no process but this one, 0 for one a core.
    """
    if jobs == 1:
        yield one_by_one
        return
    with joblib.parallel_config("loky", n_jobs=jobs or -1, inner_max_num_threads=1):
        yield spread
