"""Python's search for garbage while a run goes on."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def only_new_searched() -> Iterator[None]:
    """A context in which objects that were there before are not searched for garbage: those of the loaded modules are so many that
    each time takes a tenth of a second. Nothing changes where a program has told Python so for itself (``gc.freeze``)."""
    if gc.get_freeze_count():
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
