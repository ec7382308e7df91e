"""A process that makes one planned run after the other. What it imports first must be light: threads are chosen before numpy is."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import Connection
from pathlib import Path

from factorgraph_loc.errors import FglocError
from factorgraph_loc.experiments.threads import use_one_thread

READY = "ready"


def serve(connection: Connection, folder: Path, again: bool) -> None:
    """Say ``READY``, then answer each planned run that comes with its outcome, or with the error that stops the experiment."""
    # what an interrupt means is for the process that has all workers to say
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    use_one_thread()
    _import()
    from factorgraph_loc.experiments.execute import run_planned  # noqa: PLC0415

    connection.send(READY)
    while True:
        run = connection.recv()
        try:
            connection.send(run_planned(run, folder, again=again))
        except FglocError as error:
            connection.send(error)


def _import() -> None:
    """Load what takes seconds, so that no run pays for it."""
    import cv2  # noqa: PLC0415

    import factorgraph_loc.estimators.smoother  # noqa: PLC0415
    import factorgraph_loc.experiments.stored_run  # noqa: F401, PLC0415

    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
