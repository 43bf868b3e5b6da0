"""Work spread over the cores of this machine, or over a Dask cluster, with joblib."""

import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar
from urllib.parse import urlsplit

import joblib

from cell.errors import CellError
from cell.installation import extra
from recognition.evaluation.evaluation import Mapper, one_by_one

CONNECT_TIMEOUT_S = 15.0
"""Longest time in s until a Dask scheduler answers."""

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
def workers(jobs: int = 1, *, scheduler: str | None = None) -> Iterator[Mapper]:
    """Yield what does work for many items: here, in processes of this machine, or on a cluster.

    ``jobs`` is 1 for no process but this one, 0 for one a core. With the address of a Dask
    scheduler, as ``tcp://host:8786``, whose workers have this package in the same version, it means
    nothing.

    Raises
    ------
    CellError
        `jobs` is negative, the extra ``cluster`` is missing, or no scheduler answers in
        `CONNECT_TIMEOUT_S` s.
    """
    if jobs < 0:
        raise CellError(f"--jobs is {jobs}; 0 is one process per core, 1 is this process alone")
    if scheduler is not None:
        with _cluster(scheduler):
            yield spread
    elif jobs == 1:
        yield one_by_one
    else:
        with joblib.parallel_config("loky", n_jobs=jobs or -1, inner_max_num_threads=1):
            yield spread


@contextmanager
def _cluster(scheduler: str) -> Iterator[None]:
    with extra("cluster", needed_by="--scheduler, here and on all workers,"):
        from distributed import Client, KilledWorker  # noqa: PLC0415  slow to load
    try:
        _knock(scheduler)
        client = Client(  # type: ignore[no-untyped-call]
            scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except (OSError, ValueError, TimeoutError) as error:
        raise CellError(
            f"no Dask scheduler answers at {scheduler}: {error}; start one with `dask scheduler`"
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            raise CellError(
                f"the Dask scheduler at {scheduler} has no workers: start `dask worker`"
            )
        with joblib.parallel_config(
            "dask", client=client, wait_for_workers_timeout=CONNECT_TIMEOUT_S
        ):
            yield
    except KilledWorker as error:
        raise CellError(
            f"workers of the cluster died again and again at the same work: {error}; give them "
            "more memory. What was done before stays"
        ) from error
    finally:
        client.close()  # type: ignore[no-untyped-call]


def _knock(scheduler: str) -> None:
    """Check that a scheduler listens: a Dask client without one may wait forever.

    Raises OSError if nothing listens, ValueError for an address without host or port.
    """
    address = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
    if address.scheme not in ("tcp", "tls"):
        return
    if not address.hostname or address.port is None:
        raise ValueError("write an address as tcp://HOST:PORT")
    socket.create_connection((address.hostname, address.port), CONNECT_TIMEOUT_S).close()
