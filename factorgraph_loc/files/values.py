"""Validation of numbers, names and times that a program passes to the package.

Arrays are copied, so that the caller may reuse them. In all functions ``where`` and ``field`` name the value in messages.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import SECONDS, Column
from factors.se2 import Array

NUMBER = (int, float, np.integer, np.floating)
FEW = 30  # maximum number of values that a Python loop checks faster than NumPy


def seconds_of(where: str, value: object, name: str = "t") -> float:
    """Return the time ``value`` [s] as a float. Raises InputError if it is not a number or out of range.

    ``where``: the object that has the value. ``name``: the field of the object. The error names both.
    """
    if type(value) is float and SECONDS.low <= value <= SECONDS.high:
        return value
    seconds = math.nan
    if isinstance(value, NUMBER) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            seconds = float(value)
    if SECONDS.outside(np.array(seconds)):
        raise bad_field(where, name, value, SECONDS.expected)
    return seconds


def numbers(where: str, field: str, value: object) -> Array:
    """Return ``value`` as a new array of floats. Raises InputError if it does not consist of real numbers.

    The message starts with ``where``, such as the name of a log, and names the ``field`` that has the value.
    """
    try:
        array = np.array(value)
        if array.dtype.kind == "O" and all(
            isinstance(item, NUMBER) and not isinstance(item, bool) for item in array.flat
        ):
            array = array.astype(float)
    except (TypeError, ValueError, OverflowError):  # raised for rows of different lengths and for huge integers
        raise bad_field(where, field, value, "numbers") from None
    if array.dtype.kind not in "iuf" and array.size:
        raise bad_field(where, field, value, "numbers")
    return np.asarray(array, dtype=float)


def within(where: str, column: Column, value: object, shape: tuple[int, ...]) -> Any:
    """Return ``value`` as an array of floats, or as a float if ``shape`` is ().

    Raises InputError, starting with ``where``, if ``value`` has another shape or exceeds the bounds of ``column``.
    """
    column, field = column.measured, column.field or column.name
    array = numbers(where, field, value)
    if array.shape != shape:
        raise InputError(f"{where}: {field} has shape {array.shape}, expected {shape}")
    low, high = column.low, column.high
    if column.kind != "whole" and array.size <= FEW and all(low <= x <= high for x in array.ravel().tolist()):
        return array if shape else float(array)
    if (bad := column.outside(array)).any():
        lack = ", or NaN where not measured" if column.may_lack else ""
        raise bad_field(where, field, float(array[bad].flat[0]), column.expected + lack)
    return array if shape else float(array)


def names(where: str, field: str, value: object) -> tuple[str, ...]:
    """Return the names in ``value`` as a tuple. Raises InputError if ``value`` is not a list of texts.

    ``where``: the object that has the value. ``field``: the field of the object. The error names both.
    """
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(name, str) for name in value):
        raise bad_field(where, field, value, "names")
    return tuple(value)


def items_of(where: str, field: str, values: object) -> tuple[Any, ...]:
    """Return the items of ``values`` as a tuple. Raises InputError if ``values`` is a text or cannot be iterated.

    ``where``: the object that has the values. ``field``: the field of the object. The error names both.
    """
    items = None
    if isinstance(values, Iterable) and not isinstance(values, str):
        with contextlib.suppress(TypeError):  # raised by a zero-dimensional array
            items = tuple(values)
    if items is None:
        raise bad_field(where, field, values, f"a list of {field}")
    return items


def integers(where: str, column: Column, value: object, count: int) -> NDArray[np.int64]:
    """Return ``value`` as an array of ``count`` integers. ``where``: names the object with the value in errors.

    Raises InputError unless ``value`` consists of ``count`` whole numbers within the bounds of ``column``.
    """
    array = numbers(where, column.name, value)
    if array.shape != (count,) or (count and np.asarray(value).dtype.kind not in "iu"):
        raise bad_field(where, column.name, value, f"{count} whole numbers")
    if (bad := column.outside(array)).any():
        raise bad_field(where, column.name, float(array[bad][0]), column.expected)
    return array.astype(np.int64)
