"""What holds for any input: it is taken, or refused by one of our own errors in one short line, within a minute."""

import signal
from contextlib import contextmanager

from hypothesis import settings

from factorgraph_loc.errors import FglocError

LONGEST = 300  # characters of a message
MINUTE = 60.0  # s, of which compilation may take most


def examples(cost):
    """How many examples a test tries, of ``cost`` times the usual time: few in the suite, many with the profile ``long``."""
    return settings(max_examples=max(2, settings.default.max_examples // cost))


@contextmanager
def taken_or_refused(failed=lambda: None):
    """Let our own errors pass if their message is one short line; anything else, and more than a minute, fails the test.

    ``failed``: called where the error is that of a run, which no longer is what it was, and not that of what was given to it.
    """

    def late(*_):
        raise AssertionError(f"took more than {MINUTE:.0f} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, MINUTE)
    try:
        yield
    except FglocError as error:
        require_line(str(error))
        if error.exit_code == 1:
            failed()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def require_line(message, longest=LONGEST):
    """A message is one printable line."""
    assert message
    assert message.isprintable(), repr(message[:600])
    assert len(message) <= longest, message
