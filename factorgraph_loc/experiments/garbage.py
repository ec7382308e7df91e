"""Python's search for garbage while a run goes on."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

NEW = 1000  # objects after which they are searched; tens of thousands at once would take as long as many updates


@contextmanager
def only_new_searched() -> Iterator[None]:
    """A context in which objects that were there before, and those that have outlived two searches, are not searched for garbage:
    those of the loaded modules and of a long run are so many that each time takes a tenth of a second. Nothing changes where a
    program has told Python so for itself (``gc.freeze``)."""
    if gc.get_freeze_count():
        yield
        return
    threshold = gc.get_threshold()
    gc.freeze()
    gc.callbacks.append(_keep)
    gc.set_threshold(NEW, *threshold[1:])
    try:
        yield
    finally:
        gc.set_threshold(*threshold)
        gc.callbacks.remove(_keep)
        gc.unfreeze()


def _keep(phase: str, info: dict[str, int]) -> None:
    if phase == "stop" and info["generation"] == 1:
        gc.freeze()
