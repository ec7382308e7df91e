"""Exceptions for the user. The command line prints the message of such an exception as one line and exits with its code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from factorgraph_loc.text import error_text, one_line, plain, quoted

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray


class FglocError(Exception):
    """Base class of errors that are reported to the user. The message is one line of at most 300 characters."""

    exit_code = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class InputError(FglocError):
    """A file, an option or an argument is invalid."""


class RunFailedError(FglocError):
    """The input is valid, but the run has no usable result."""

    exit_code = 1


def bad_field(file: object, field: str, value: object, expected: str, *, row: int | None = None) -> InputError:
    """Return the error for an invalid value: "FILE:ROW: FIELD is VALUE, expected EXPECTED". ``row``: line number."""
    where = f"{plain(file)}:{row}" if row is not None else plain(file)
    return InputError(f"{where}: {plain(field)} is {quoted(value)}, expected {expected}")


def require(
    valid: NDArray[np.bool_],
    file: object,
    rows: Sequence[int] | NDArray[np.int64],
    field: str,
    values: NDArray[Any],
    expected: str,
) -> None:
    """Raise InputError at the first of the ``values`` (N, ...) that is invalid, if any.

    ``valid`` (N,): a mask of the valid values. ``rows`` (N,): line numbers of the values in ``file``. ``field``: the
    name of the values. ``expected``: a description of valid values. The message is that of :func:`bad_field`.
    """
    if not valid.all():
        i = int(valid.argmin())
        raise bad_field(file, field, values[i].tolist(), expected, row=int(rows[i]))


def message_of(error: FglocError | OSError | UnicodeEncodeError) -> str:
    """Return the message of an error on one line, for display to the user."""
    if isinstance(error, UnicodeEncodeError):
        text = quoted(error.object[error.start : error.end])
        return f"{text} cannot be written in {error.encoding}, the encoding of this system: set PYTHONUTF8=1"
    if isinstance(error, OSError):
        text = error_text(error)
        return one_line(text if error.filename is None else f"{plain(error.filename)}: {text}")
    return str(error)
