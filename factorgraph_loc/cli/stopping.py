"""Handling of signals that end the command: temporary files are removed first."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from factorgraph_loc.cli import show

AGAIN = 0.05  # s
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}


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
    """Raise the :class:`Stop` that an exception was raised from in its place: compiled modules turn it into an ImportError where it
    comes while they are loaded."""
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
    before: dict[signal.Signals, Any] = {}
    hook = sys.unraisablehook

    def stop(number: int, _: FrameType | None) -> None:
        for one in before:
            signal.signal(one, signal.SIG_DFL)
        raise Stop(number)

    def lost(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, Stop):
            number = unraisable.exc_value.number
            signal.signal(number, stop)
            threading.Timer(AGAIN, os.kill, (os.getpid(), number)).start()
        else:
            hook(unraisable)

    for one in WORDS:
        if signal.getsignal(one) not in (signal.SIG_IGN, None):
            before[one] = signal.signal(one, stop)
    sys.unraisablehook = lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for one, handler in before.items():
            signal.signal(one, handler)
