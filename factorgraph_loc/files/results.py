"""Checks and errors of commands that write results."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.temporary import sweep


@contextmanager
def writing(path: object) -> Iterator[None]:
    """Context in which an OSError is raised as an InputError that names ``path``."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def require_free(out: Path, names: Iterable[str], *, overwrite: bool, folders: Iterable[Path] = ()) -> None:
    """Raise InputError if ``out`` is not a folder, or contains one of the files ``names`` that must not be replaced.

    Temporary files of previous calls are removed from ``out`` and ``folders``.
    """
    for folder in (out, *folders):
        sweep(folder)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected a folder for the results")
    held = [name for name in names if (out / name).exists()]
    if held and not overwrite:
        raise InputError(f"{out}: holds results already ({held[0]}); choose another folder, or --overwrite")
