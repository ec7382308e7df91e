"""A worker process for planned runs. Its first imports must be light: the number of threads is set before numpy is imported."""

from multiprocessing.connection import Connection
from pathlib import Path

from factorgraph_loc.errors import FglocError

READY = "ready"


def serve(connection: Connection, folder: Path, again: bool) -> None:
    """Send ``READY``, then answer each planned run with its outcome, or with the error that stops the experiment."""
    _import()
    from factorgraph_loc.experiments.execute import run_planned  # noqa: PLC0415

    connection.send(READY)
    while True:
        try:
            run = connection.recv()
        except EOFError:  # the parent has ended
            return
        try:
            connection.send(run_planned(run, folder, again=again))
        except FglocError as error:
            connection.send(error)


def _import() -> None:
    """Import slow modules before the first run."""
    import cv2  # noqa: PLC0415

    import factorgraph_loc.experiments.output  # noqa: F401, PLC0415

    cv2.setNumThreads(1)
