"""The exceptions that a user can cause. The command line prints them in one line and exits with their code."""

from factorgraph_loc.text import one_line, plain, quoted, told


class FglocError(Exception):
    """Base of all errors that are reported to the user as one line, which its text always is, of at most 300 characters."""

    exit_code = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class InputError(FglocError):
    """Something in a file, an option or an argument is not as expected."""


class RunFailedError(FglocError):
    """The input is in order, but the run gave no usable result."""

    exit_code = 1


def bad_field(file: object, field: str, value: object, expected: str, *, row: int | None = None) -> InputError:
    """The error for one bad field: file, row (counted as an editor counts lines), field, value, what is expected."""
    where = f"{plain(file)}:{row}" if row is not None else plain(file)
    return InputError(f"{where}: {plain(field)} is {quoted(value)}, expected {expected}")


def unusable(error: OSError, path: object = None) -> InputError:
    """The error for a file or a folder that the system does not let us read or write: ``path``, if the error names none."""
    where = error.filename if error.filename is not None else path
    return InputError(f"{plain(where)}: {told(error)}" if where is not None else told(error))
