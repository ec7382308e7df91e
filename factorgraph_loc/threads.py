"""Limits the linear algebra of a process to one thread, which is fastest for small matrices and for parallel runs.

This module must be importable without numpy; call the function before numpy is imported.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_one_thread() -> None:
    """Set one thread for BLAS, OpenMP and numba, unless the environment says otherwise; child processes inherit it."""
    for variable in _VARIABLES:
        os.environ.setdefault(variable, "1")
