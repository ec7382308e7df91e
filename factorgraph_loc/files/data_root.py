"""The data folder, and paths in manifests and experiment files, which may lead there."""

import os
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import inside

DATA_ROOT = "FGLOC_DATA"
RUN_FILE = "run.toml"  # of a log in the native format; a manifest may have this name too
EXPECTED = f"one below it, or below the data folder (--data-root, {DATA_ROOT})"


def find_data_root(data_root: str | Path | None, source: object) -> Path:
    """The data folder: the argument, else that of the environment; InputError if there is none."""
    if data_root is None:
        data_root = os.environ.get(DATA_ROOT)
        if not data_root:
            raise InputError(f"{source}: needs the data folder: give --data-root or set {DATA_ROOT}")
    folder = Path(data_root)
    if not folder.is_dir():
        raise InputError(f"{source}: the data folder {folder} does not exist")
    return folder


def named_path(folder: Path, name: str, source: object, data_root: str | Path | None, expected: str = EXPECTED) -> Path:
    """The path ``name`` in a manifest or an experiment file ``source`` of ``folder``: below that folder or the data folder.

    It need not exist. Other files lead below their own folder only, see :func:`~factorgraph_loc.files.models.inside`, which raises
    the same errors.
    """
    data = os.environ.get(DATA_ROOT) if data_root is None else data_root
    folders = [Path(data)] if data and Path(data).is_dir() else []
    return inside(folder, name, source, *folders, expected=expected)
