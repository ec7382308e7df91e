"""Counts of function calls, for tests of how the work grows with the input."""

import sys
from collections import Counter


def calls_of(function):
    """The number of calls of each function, by name, while ``function`` runs; of Python's and of compiled ones."""
    counts = Counter()

    def profile(frame, event, called):
        if event == "call":
            counts[frame.f_code.co_name] += 1
        elif event == "c_call":
            counts[called.__name__] += 1

    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(None)
    return counts
