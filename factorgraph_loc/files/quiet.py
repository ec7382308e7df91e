"""Standard error while libraries in C or Rust read a damaged file: they write to it what an error of ours says in one line.

libpng and libjpeg write there whatever OpenCV's log level is, and threads of polars that stumble over a page before they raise.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """What is written to descriptor 2 in this block is lost, if the main thread is in it; in other threads it does nothing.

    The descriptor is that of all threads, so what another one writes meanwhile is lost too. Therefore a block holds the call that
    reads one file and no more: milliseconds for an image, at worst seconds for a table of a gigabyte. What can be missed is a
    frame of a progress bar, which is drawn again: errors of other threads are exceptions, which are told later. Two threads in such
    blocks could leave the descriptor lost for good, hence the main thread alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
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
