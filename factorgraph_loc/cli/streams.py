"""Standard output and standard error that fail with one line and an exit code when they are closed, full or cannot encode text."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn, TextIO

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import told

PIPE_CLOSED = 141  # 128 and the number of SIGPIPE, as in shells


class OutputError(InputError):
    """Standard output is closed, or its file system is full."""


class _Output(io.TextIOWrapper):
    """Standard output. If the reader of a pipe closes it, the command ends silently."""

    def write(self, text: str, /) -> int:
        try:
            return super().write(text) if text != "" else 0  # libraries write "" to probe the stream
        except OSError as error:
            _give_up(error)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            _give_up(error)


class _Messages(io.TextIOWrapper):
    """Standard error; failures to write are ignored, because they cannot be reported."""

    def write(self, text: str, /) -> int:
        try:
            return super().write(text)
        except OSError:
            _discard(2)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError:
            _discard(2)


@contextmanager
def standard_streams() -> Iterator[None]:
    """Replace the standard streams of the interpreter in this block, and flush them at its end.

    A closed descriptor is opened on the null device, so that no other file gets its number.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):  # read-only 1 keeps refusing writes
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # gets the lowest free number, which is this one
    if sys.stdout is sys.__stdout__:  # otherwise it was replaced, as in a test
        sys.stdout = _replaced(sys.stdout, 1, _Output, "replace")
    if sys.stderr is sys.__stderr__:
        sys.stderr = _replaced(sys.stderr, 2, _Messages, "backslashreplace")
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stdout.flush()


def _replaced(stream: TextIO | None, number: int, kind: type[io.TextIOWrapper], errors: str) -> io.TextIOWrapper:
    """A stream of ``kind`` on the target of ``stream``; None if the descriptor was closed."""
    if not isinstance(stream, io.TextIOWrapper):
        return kind(os.fdopen(number, "wb", closefd=False), "utf-8", errors)
    encoding, unbuffered, by_line = stream.encoding, stream.write_through, stream.line_buffering
    return kind(stream.detach(), encoding, errors, line_buffering=by_line, write_through=unbuffered)


def _give_up(error: OSError) -> NoReturn:
    _discard(1)
    if isinstance(error, BrokenPipeError):
        raise SystemExit(PIPE_CLOSED) from error
    raise OutputError(f"standard output: cannot be written: {told(error)}") from error


def _discard(number: int) -> None:
    """Redirect the descriptor and its buffered data to the null device."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, number)
    os.close(null)
