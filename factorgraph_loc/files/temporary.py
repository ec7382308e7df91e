"""Temporary files and folders next to their targets; checks and errors of commands that write results.

Their names consist of a dot, the target's name, :data:`MARK`, the machine, the number of the process and eight digits. Those of
processes that have ended are removed when a command that writes to the same folder starts.
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
_NAMED, _SUFFIX = 150, 60  # bytes used of a name and of a suffix; file systems allow 255 in total
_MACHINE = f"{zlib.crc32(socket.gethostname().encode()):08x}"
MAX_AGE = 7 * 86_400.0  # s after which a file of another machine, whose processes are unknown, is removed
_swept: set[Path] = set()  # folders that this process has cleaned up
_own: set[Path] = set()  # paths created by this process and not yet removed


def temporary_file(path: Path) -> AbstractContextManager[Path]:
    """An empty file next to ``path``, with its suffix; removed at the end of the block unless it was renamed."""
    return _created(path, path.stem, path.suffix, folder=False)


def temporary_folder(path: Path) -> AbstractContextManager[Path]:
    """A new private folder next to ``path``; removed with its content at the end of the block."""
    return _created(path, path.name, "", folder=True)


def of_system(name: str) -> Path:
    """A path with this name in the system's temporary folder."""
    return Path(tempfile.gettempdir()) / name


def sweep(folder: Path) -> None:
    """Remove this user's temporary files in ``folder`` that belong to no running process."""
    with suppress(OSError):  # the folder does not exist
        for entry in os.scandir(folder):
            with suppress(OSError):  # removed by another process
                if _is_left(entry):
                    _remove(folder / entry.name)


def _is_left(entry: os.DirEntry[str]) -> bool:
    """Whether an entry of a folder is a temporary file or folder of a process that has ended."""
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
    except PermissionError:  # of another user
        pass
    return False


def remove_own() -> None:
    """Remove everything that this process has created and not removed, after a signal."""
    for path in list(_own):
        _remove(path)


@contextmanager
def _created(path: Path, name: str, suffix: str, *, folder: bool) -> Iterator[Path]:
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
            error.filename = str(path)  # the user knows the target only
        raise
    finally:
        _remove(made)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file ``path``, which is not removed; no effect if the file system does not support locks."""
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
    """Context that turns an OSError, or a name that cannot be encoded, into an InputError with ``path``."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error_text(error)}") from error
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: cannot be written: {message_of(error)}") from error


def new_below(folder: Path, name: str) -> Path:
    """The first of ``name``, ``name-2``, ``name-3``, ... that does not exist in a folder."""
    numbered = (name if i == 1 else f"{name}-{i}" for i in itertools.count(1))
    return next(path for text in numbered if not (path := folder / text).exists())


def require_free(out: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise InputError if ``out`` is not a folder, or contains one of the files ``names`` that must not be replaced.

    Temporary files of previous calls are removed from ``out``, its ``plots`` and its parent.
    """
    for folder in (out.parent, out, out / "plots"):
        sweep(folder)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected a folder for the results")
    existing = [name for name in names if (out / name).exists()]
    if existing and not overwrite:
        raise InputError(f"{out}: holds results already ({existing[0]}); choose another folder, or --overwrite")
