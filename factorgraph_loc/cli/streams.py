"""Standard output and standard error as the command uses them: what they cannot take, being closed, full or of few characters,
ends in a line and an exit code, never in a traceback, nor in a message of the interpreter as it ends."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn, TextIO

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import told

PIPE_CLOSED = 141  # as shells count it: 128 and the number of SIGPIPE


class OutputError(InputError):
    """Standard output takes nothing: it is closed, or what it goes to is full."""


class _Output(io.TextIOWrapper):
    """Standard output. Who reads no further from a pipe is no error: the command ends, without a word."""

    def write(self, text: str, /) -> int:
        try:
            return super().write(text) if text != "" else 0  # that is how others try what kind of stream this is
        except OSError as error:
            _give_up(error)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            _give_up(error)


class _Messages(io.TextIOWrapper):
    """Standard error: there is nowhere to say that it takes nothing."""

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
    """Put these in the place of the interpreter's, and write out what they hold at the end of the block.

    A descriptor that is closed is taken by the null device, lest a file that is opened gets its number, and what libraries print
    in native code gets into that file.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):  # 1 goes on refusing what is written
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # it gets the lowest number that is free, which is this
    if sys.stdout is sys.__stdout__:  # else it is another's, as in a test
        sys.stdout = _replaced(sys.stdout, 1, _Output, "replace")
    if sys.stderr is sys.__stderr__:
        sys.stderr = _replaced(sys.stderr, 2, _Messages, "backslashreplace")
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stdout.flush()


def _replaced(stream: TextIO | None, number: int, kind: type[io.TextIOWrapper], errors: str) -> io.TextIOWrapper:
    """A stream of ``kind`` for what ``stream`` goes to, None where the descriptor was closed."""
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
    """What goes to the descriptor, and what is held back for it, goes nowhere from now on."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, number)
    os.close(null)
