"""The data folder, and the resolution of paths in manifests and experiment files, which may lead to it."""

import os
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import inside

DATA_ROOT = "FGLOC_DATA"
RUN_FILE = "run.toml"  # main file of a log in the native format; a manifest may have this name too
EXPECTED = f"a path below it, or below the data folder (--data-root, {DATA_ROOT})"


def find_data_root(data_root: str | Path | None, source: object) -> Path:
    """Return the data folder: ``data_root``, or if it is None the folder in the environment variable FGLOC_DATA.

    ``source``: the file that needs the folder, for messages. Raises InputError if neither is set or the folder does not exist.
    """
    if data_root is None:
        data_root = os.environ.get(DATA_ROOT)
        if not data_root:
            raise InputError(f"{source}: needs the data folder: give --data-root or set {DATA_ROOT}")
    folder = Path(data_root)
    if not folder.is_dir():
        raise InputError(f"{source}: the data folder {folder} does not exist")
    return folder


def named_path(folder: Path, name: str, source: object, data_root: str | Path | None, expected: str = EXPECTED) -> Path:
    """Return the path that ``name``, a text in a manifest or an experiment file, refers to.

    ``source``: the file that contains ``name``. ``folder``: the folder of ``source``. The path must lead below
    ``folder`` or below ``data_root``, which is the environment variable FGLOC_DATA by default. Otherwise InputError is
    raised. The path need not exist. ``expected``: end of the error.
    """
    data = os.environ.get(DATA_ROOT) if data_root is None else data_root
    folders = [Path(data)] if data and Path(data).is_dir() else []
    return inside(folder, name, source, *folders, expected=expected)
