"""Limit of the linear algebra library (BLAS) to one thread while a cell trains or answers.

The matrices here are small: more threads gain nothing, and OpenBLAS lets them spin, which delays
the force loop and the host's own threads.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within the block, then restore its limit.

    Also a decorator. BLAS has one limit for the whole process: a limit that another thread sets by
    threadpoolctl meanwhile stays.
    """
    # Searched each time: numpy and scipy each have a library, and scipy's is loaded later.
    with threadpool_limits(limits=1, user_api="blas"):
        yield
