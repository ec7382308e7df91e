"""MATLAB files: named arrays of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from factorgraph_loc.errors import InputError
from factors.se2 import Array


def read_matlab(path: Path, fields: Mapping[str, int]) -> dict[str, Array]:
    """The arrays (N, K) of ``fields`` (name -> K); InputError names file and field of what is missing or shaped otherwise."""
    arrays = read_arrays(path, {name: (None, width) for name, width in fields.items()})
    for name, array in arrays.items():
        if len(array) == 0:
            raise InputError(f"{path}: {name} holds no rows")
    return arrays


def read_arrays(path: Path, shapes: Mapping[str, tuple[int | None, ...]]) -> dict[str, Array]:
    """The arrays of ``shapes`` (name -> size along each axis, None for any); InputError as of :func:`read_matlab`."""
    try:
        # only the fields that are needed: a file may hold things that are not numbers
        content = loadmat(str(path), variable_names=list(shapes))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # scipy raises what its parser stumbles over: ValueError, TypeError, zlib.error, ...
        raise InputError(f"{path}: is not a MATLAB file (of version 7 or before)") from error
    arrays = {}
    for name, shape in shapes.items():
        if name not in content:
            raise InputError(f"{path}: {name} is missing")
        array = content[name]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "fiub":
            raise InputError(f"{path}: {name} has shape {array.shape}, expected numbers in {_described(shape)}")
        arrays[name] = np.asarray(array, dtype=float)
    return arrays


def _described(shape: tuple[int | None, ...]) -> str:
    if len(shape) == 2 and shape[0] is None:
        return f"{shape[1]} columns"
    return " x ".join("any" if n is None else str(n) for n in shape)
