"""Orderly ends of a command after a signal, and when its output cannot be written.

After a signal the command removes its temporary files and prints one line. If standard output is closed or its disk is
full, the command ends with one line and an exit code.
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

RETRY_INTERVAL = 0.05  # s; a signal whose exception Python has dropped is sent again after this time
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
PIPE_CLOSED = 141  # exit code: 128 plus the number of SIGPIPE, as in shells


class Stop(KeyboardInterrupt):
    """Raised in the main thread when a signal ends the command. ``number``: the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = signal.Signals(number)


def end(stop: KeyboardInterrupt) -> int:
    """Remove temporary files, and print the signal and the notes of the exception ``stop`` on stderr.

    Return the exit code, which is 128 plus the number of the signal."""
    from factorgraph_loc.files.temporary import remove_own

    remove_own()
    number = stop.number if isinstance(stop, Stop) else signal.SIGINT
    show.note("; ".join([WORDS[number], *getattr(stop, "__notes__", ())]))
    return 128 + number


@contextmanager
def unwrapped() -> Iterator[None]:
    """If an exception in this block was caused by a :class:`Stop`, which a signal raises, raise the :class:`Stop`
    instead.

    For example, a compiled module raises ImportError if a signal interrupts its import.
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
    """Raise :class:`Stop` if a signal of :data:`WORDS` arrives in this block. Signals that the process ignores stay
    ignored.

    A second signal ends the process immediately. Limitation: Python drops exceptions in destructors and callbacks. If
    it drops a :class:`Stop`, the signal is sent again.
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
    """Standard output cannot be written, because it is closed or its disk is full."""


class _Output(io.TextIOWrapper):
    """Standard output. If the reader of a pipe has closed it, the command ends silently; other errors raise OutputError."""

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
    """Standard error. Write errors are ignored, because they cannot be reported anywhere."""

    def give_up(self, _: OSError) -> None:
        _discard(2)


@contextmanager
def standard_streams() -> Iterator[None]:
    """Replace ``sys.stdout`` and ``sys.stderr`` by streams that handle write errors. Flush them at the end of the block.

    A closed descriptor 0, 1 or 2 is opened on the null device, so that no other file gets its number.
    """
    # descriptor 1 is opened for reading, so that writes to a closed standard output still fail
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # the lowest free descriptor is ``number``
    if sys.stdout is sys.__stdout__:  # false if a caller, such as a test, has replaced it
        sys.stdout = _replaced(sys.stdout, 1, _Output, "replace")
    if sys.stderr is sys.__stderr__:
        sys.stderr = _replaced(sys.stderr, 2, _Messages, "backslashreplace")
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stdout.flush()


def _replaced(stream: TextIO | None, number: int, kind: type[io.TextIOWrapper], errors: str) -> io.TextIOWrapper:
    """Return a stream of class ``kind`` that writes to the descriptor of ``stream``.

    ``number``: the descriptor to use if ``stream`` is None, which means that it was closed when Python started.
    ``errors``: how characters that cannot be encoded are replaced."""
    if not isinstance(stream, io.TextIOWrapper):
        return kind(os.fdopen(number, "wb", closefd=False), "utf-8", errors)
    encoding, unbuffered, by_line = stream.encoding, stream.write_through, stream.line_buffering
    return kind(stream.detach(), encoding, errors, line_buffering=by_line, write_through=unbuffered)


def _discard(number: int) -> None:
    """Redirect the file descriptor ``number`` to the null device, so that buffered data are discarded."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, number)
    os.close(null)
