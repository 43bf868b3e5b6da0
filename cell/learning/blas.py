"""Limit of the linear algebra library (BLAS) to one thread while a cell trains or answers.

The matrices here are small: further threads gain nothing, and OpenBLAS lets them spin against the
force loop and the host's own threads.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give BLAS one thread within the block, and what it had before at its end.

    Serves as a decorator too. BLAS has one limit for the whole process: where another thread
    holds one by threadpoolctl meanwhile, that one stays.
    """
    # Looked for anew each time: numpy and scipy each bring a library, and scipy's is loaded later.
    with threadpool_limits(limits=1, user_api="blas"):
        yield
