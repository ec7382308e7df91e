"""MATLAB files: named arrays of numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import loadmat

from factorgraph_loc.errors import InputError
from factors.se2 import Array


def read_matlab(path: Path, fields: dict[str, int]) -> dict[str, Array]:
    """The arrays (N, K) of ``fields`` (name -> K); InputError names file and field of what is missing or shaped otherwise."""
    try:
        # only the fields that are needed: a file may hold things that are not numbers
        content = loadmat(str(path), variable_names=list(fields))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # scipy raises what its parser stumbles over: ValueError, TypeError, zlib.error, ...
        raise InputError(f"{path}: is not a MATLAB file (of version 7 or before)") from error
    arrays = {}
    for name, width in fields.items():
        if name not in content:
            raise InputError(f"{path}: {name} is missing")
        array = content[name]
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiub":
            raise InputError(f"{path}: {name} has shape {array.shape}, expected numbers in {width} columns")
        if len(array) == 0:
            raise InputError(f"{path}: {name} holds no rows")
        arrays[name] = np.asarray(array, dtype=float)
    return arrays
