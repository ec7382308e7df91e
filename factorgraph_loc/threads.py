"""One thread for the linear algebra of a process.

The matrices of an estimator are small: more threads cost time, and runs in parallel processes would fight for the cores.
This module must be importable without numpy, and the function be called before anything imports numpy.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_one_thread() -> None:
    """Ask BLAS, OpenMP and numba for one thread, unless the user's environment says otherwise; inherited by workers."""
    for variable in _VARIABLES:
        os.environ.setdefault(variable, "1")
