"""Temporary files and folders next to the files that they will replace, and checks before a command writes results.

The name of a temporary file consists of a dot, the name of the target, :data:`MARK`, a hash of the host name, the process id and
eight random digits. A temporary file whose process has ended is removed when a later process writes to the same folder.
"""

import fcntl
import itertools
import os
import re
import secrets
import shutil
import socket
import sys
import tempfile
import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from factorgraph_loc.errors import InputError, message_of
from factorgraph_loc.text import error_text

MARK = ".fgloc-"
_NAME = re.compile(rf"\..*{re.escape(MARK)}([0-9a-f]{{8}})-([1-9][0-9]*)-[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)
_NAMED, _SUFFIX = 150, 60  # maximum bytes kept of a target's name and of its suffix; file systems allow 255 in total
_MACHINE = f"{zlib.crc32(socket.gethostname().encode()):08x}"
MAX_AGE = 7 * 86_400.0  # s; maximum age of a file of another machine
_swept: set[Path] = set()  # folders that this process has cleared of old temporary files
_own: set[Path] = set()  # paths created by this process and not yet removed


def temporary_file(path: Path) -> AbstractContextManager[Path]:
    """Return a context manager that creates an empty file next to ``path``, with the same suffix, and gives its path.

    The file is removed at the end of the block unless it was renamed.
    """
    return _created(path, path.stem, path.suffix, folder=False)


def temporary_folder(path: Path) -> AbstractContextManager[Path]:
    """Return a context manager that creates a folder next to ``path`` for this user only, and gives its path.

    The folder and its content are removed at the end of the block.
    """
    return _created(path, path.name, "", folder=True)


def of_system(name: str) -> Path:
    """Return the path ``name`` in the temporary folder of the system, such as ``/tmp/NAME``. Nothing is created."""
    return Path(tempfile.gettempdir()) / name


def sweep(folder: Path) -> None:
    """Remove temporary files and folders that ended processes of this user have left in ``folder``."""
    with suppress(OSError):  # if the folder does not exist
        for entry in os.scandir(folder):
            with suppress(OSError):  # if another process has removed the file
                if _is_left(entry):
                    _remove(folder / entry.name)


def _is_left(entry: os.DirEntry[str]) -> bool:
    """True if an entry of a folder is a temporary file or folder of this user, and its process has ended."""
    name = _NAME.fullmatch(entry.name)
    regular = entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False)
    if name is None or not regular or entry.stat(follow_symlinks=False).st_uid != os.geteuid():
        return False
    machine, process = name[1], int(name[2])
    if machine != _MACHINE:
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > MAX_AGE
    if process == os.getpid():
        return entry.name not in {path.name for path in _own}
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:  # the process runs, but belongs to another user
        pass
    return False


def remove_own() -> None:
    """Remove all temporary files and folders of this process. Call this after a signal, before the process ends."""
    for path in list(_own):
        _remove(path)


@contextmanager
def _created(path: Path, name: str, suffix: str, *, folder: bool) -> Iterator[Path]:
    """Create a temporary file or ``folder`` next to ``path``, with parts of ``name`` and ``suffix`` in its name. Remove
    it at the end of the block."""
    if path.parent not in _swept:
        _swept.add(path.parent)
        sweep(path.parent)
    start = "." + os.fsencode(name)[:_NAMED].decode(sys.getfilesystemencoding(), errors="ignore") + MARK
    ending = suffix if len(os.fsencode(suffix)) <= _SUFFIX else ""
    made = path.parent / f"{start}{_MACHINE}-{os.getpid()}-{secrets.token_hex(4)}{ending}"
    _own.add(made)
    try:
        if folder:
            made.mkdir(mode=0o700)
        else:
            os.close(os.open(made, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))
        yield made
    except OSError as error:
        if error.errno is not None and str(error.filename) in ("None", str(made)):
            error.filename = str(path)  # the user does not know the name of the temporary file
        raise
    finally:
        _remove(made)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file ``path`` in this block, if the file system supports locks.

    The file is created if it is missing, and is not removed.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
    _own.discard(path)


@contextmanager
def writing(path: object) -> Iterator[None]:
    """Convert an OSError or UnicodeEncodeError in this block to an InputError: "PATH: cannot be written: ..."."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error_text(error)}") from error
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: cannot be written: {message_of(error)}") from error


def new_below(folder: Path, name: str) -> Path:
    """Return a path in ``folder`` that does not exist: the first of ``name``, ``name-2``, ``name-3``, and so on."""
    numbered = (name if i == 1 else f"{name}-{i}" for i in itertools.count(1))
    return next(path for text in numbered if not (path := folder / text).exists())


def require_free(out: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise InputError if results cannot be written to the folder ``out``.

    That is the case if ``out`` is a file, or if it has one of the files ``names`` and ``overwrite`` is False. Temporary
    files of ended processes are removed from ``out``, ``out/plots`` and the parent of ``out``.
    """
    for folder in (out.parent, out, out / "plots"):
        sweep(folder)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected a folder for the results")
    existing = [name for name in names if (out / name).exists()]
    if existing and not overwrite:
        raise InputError(f"{out}: holds results already ({existing[0]}); choose another folder, or give --overwrite")
