"""Ends of the command: on a signal it removes temporary files first. If standard output or standard error are closed, full or
cannot encode text, it ends with one line and an exit code.
"""

import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TextIO

from factorgraph_loc.cli import show
from factorgraph_loc.errors import InputError
from factorgraph_loc.text import error_text

RETRY_INTERVAL = 0.05  # s
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
PIPE_CLOSED = 141  # 128 and the number of SIGPIPE, as in shells


class Stop(KeyboardInterrupt):
    """A signal that ends the command."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = signal.Signals(number)


def end(stop: KeyboardInterrupt) -> int:
    """Remove temporary files and print one line on stderr with the cause and the notes of the exception. Returns the exit code,
    128 plus the number of the signal."""
    from factorgraph_loc.files.temporary import remove_own

    remove_own()
    number = stop.number if isinstance(stop, Stop) else signal.SIGINT
    show.note("; ".join([WORDS[number], *getattr(stop, "__notes__", ())]))
    return 128 + number


@contextmanager
def unwrapped() -> Iterator[None]:
    """Raise the :class:`Stop` behind an exception in place of that: while compiled modules are loaded they turn it into an
    ImportError.
    """
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, Stop):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        raise cause from None


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise the signals of :data:`WORDS` as :class:`Stop` in this block, except those that were ignored before.

    A second signal ends the process as usual. If Python cannot propagate the exception, in a destructor or callback, the signal
    is sent again.
    """
    handlers: dict[signal.Signals, Any] = {}
    hook = sys.unraisablehook

    def stop(number: int, _: FrameType | None) -> None:
        for signum in handlers:
            signal.signal(signum, signal.SIG_DFL)
        raise Stop(number)

    def lost(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, Stop):
            number = unraisable.exc_value.number
            signal.signal(number, stop)
            threading.Timer(RETRY_INTERVAL, os.kill, (os.getpid(), number)).start()
        else:
            hook(unraisable)

    for signum in WORDS:
        if signal.getsignal(signum) not in (signal.SIG_IGN, None):
            handlers[signum] = signal.signal(signum, stop)
    sys.unraisablehook = lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for signum, handler in handlers.items():
            signal.signal(signum, handler)


class OutputError(InputError):
    """Standard output is closed, or its file system is full."""


class _Output(io.TextIOWrapper):
    """Standard output. If the reader of a pipe closes it, the command ends silently."""

    def write(self, text: str, /) -> int:
        try:
            return super().write(text) if text != "" else 0  # libraries write "" to probe the stream
        except OSError as error:
            self.give_up(error)
        return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self.give_up(error)

    def give_up(self, error: OSError) -> None:
        _discard(1)
        if isinstance(error, BrokenPipeError):
            raise SystemExit(PIPE_CLOSED) from error
        raise OutputError(f"standard output: cannot be written: {error_text(error)}") from error


class _Messages(_Output):
    """Standard error; failures to write are ignored, because they cannot be reported."""

    def give_up(self, _: OSError) -> None:
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


def _discard(number: int) -> None:
    """Redirect the descriptor and its buffered data to the null device."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, number)
    os.close(null)
