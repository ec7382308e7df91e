"""Suppression of messages that C and Rust libraries print to standard error about damaged files.

libpng and libjpeg ignore OpenCV's log level; polars prints from its threads before it raises.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """Discard writes to descriptor 2 in this block; only in the main thread, otherwise it has no effect.

    The descriptor is shared by all threads, so their messages are lost too. Therefore a block should contain only the call that
    reads one file. In several threads, such blocks could leave the descriptor redirected for good.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        kept = os.dup(2)
    except OSError:  # the descriptor is closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
