"""Limits the linear algebra of a process to one thread, which is fastest for small matrices and for parallel runs.

This module imports no numpy, because its function must be called before numpy is imported.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_one_thread() -> None:
    """Limit BLAS, OpenMP and numba to one thread by environment variables, which child processes inherit.

    Variables that are already set are not changed.
    """
    for variable in _VARIABLES:
        os.environ.setdefault(variable, "1")
