"""A process that makes one planned run after the other. What it imports first must be light: threads are chosen before numpy is."""

from multiprocessing.connection import Connection
from pathlib import Path

from factorgraph_loc.errors import FglocError

READY = "ready"


def serve(connection: Connection, folder: Path, again: bool) -> None:
    """Say ``READY``, then answer each planned run that comes with its outcome, or with the error that stops the experiment."""
    _import()
    from factorgraph_loc.experiments.execute import run_planned  # noqa: PLC0415

    connection.send(READY)
    while True:
        try:
            run = connection.recv()
        except EOFError:  # nobody is there to ask for more
            return
        try:
            connection.send(run_planned(run, folder, again=again))
        except FglocError as error:
            connection.send(error)


def _import() -> None:
    """Load what takes seconds, so that no run pays for it."""
    import cv2  # noqa: PLC0415

    import factorgraph_loc.experiments.stored_run  # noqa: F401, PLC0415

    cv2.setNumThreads(1)
