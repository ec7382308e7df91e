"""The exceptions that a user can cause. The command line prints them in one line and exits with their code."""


class FglocError(Exception):
    """Base of all errors that are reported to the user as one line."""

    exit_code = 2


class InputError(FglocError):
    """Something in a file, an option or an argument is not as expected."""


class RunFailedError(FglocError):
    """The input is in order, but the run gave no usable result."""

    exit_code = 1


def bad_field(file: object, field: str, value: object, expected: str, *, row: int | None = None) -> InputError:
    """The error for one bad field: file, row (counted as an editor counts lines), field, value, what is expected."""
    where = f"{file}:{row}" if row is not None else f"{file}"
    return InputError(f"{where}: {field} is {value!r}, expected {expected}")
