"""Temporary files and folders next to their targets; checks and errors of commands that write results.

Their names consist of a dot, the target's name, :data:`MARK` and eight digits. The creating process holds a lock, which the system
releases when the process ends. Unlocked ones are removed when a command that writes to the same folder starts.
"""

import errno
import fcntl
import os
import re
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from factorgraph_loc.errors import InputError, unencodable
from factorgraph_loc.text import told

MARK = ".fgloc-"
_NAME = re.compile(rf"\..*{re.escape(MARK)}[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)
_NAMED, _SUFFIX = 150, 60  # bytes used of a name and of a suffix; file systems allow 255 in total
ATTEMPTS = 20  # to create a file whose name another process may take or remove at that moment
_swept: set[Path] = set()  # folders that this process has cleaned up
_own: set[Path] = set()  # paths created by this process and not yet removed


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """An empty file next to ``path``, with its suffix; removed at the end of the block unless it was renamed."""
    with _held(path, path.stem, path.suffix, folder=False) as made:
        yield made


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """A new private folder next to ``path``; removed with its content at the end of the block."""
    with _held(path, path.name, "", folder=True) as made:
        yield made


def of_system(name: str) -> Path:
    """A path with this name in the system's temporary folder."""
    return Path(tempfile.gettempdir()) / name


def sweep(folder: Path) -> None:
    """Remove this user's temporary files in ``folder`` that belong to no running process."""
    with suppress(OSError):  # the folder does not exist
        for entry in os.scandir(folder):
            if _NAME.fullmatch(entry.name):
                with suppress(OSError):  # locked, or removed by another process
                    _remove_unheld(folder / entry.name)


def remove_own() -> None:
    """Remove everything that this process has created and not removed, after a signal."""
    for path in list(_own):
        _remove(path)


@contextmanager
def _held(path: Path, name: str, suffix: str, *, folder: bool) -> Iterator[Path]:
    if path.parent not in _swept:
        _swept.add(path.parent)
        sweep(path.parent)
    start = "." + os.fsencode(name)[:_NAMED].decode(sys.getfilesystemencoding(), errors="ignore") + MARK
    ending = suffix if len(os.fsencode(suffix)) <= _SUFFIX else ""
    names = (path.parent / f"{start}{secrets.token_hex(4)}{ending}" for _ in range(ATTEMPTS))
    made, handle = _make_one(names, path, folder=folder)
    try:
        yield made
    except OSError as error:
        if error.errno is not None and str(error.filename) in ("None", str(made)):
            error.filename = str(path)  # the user knows the target only
        raise
    finally:
        _remove(made)
        os.close(handle)


def _make_one(names: Iterable[Path], target: Path, *, folder: bool) -> tuple[Path, int]:
    """The first of ``names`` that could be made, a file or a folder, with a handle on it. OSError that names the ``target`` if none
    could."""
    failure: OSError = FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
    for path in names:
        _own.add(path)
        try:
            handle = _make(path, folder=folder)
        except OSError as error:
            _own.discard(path)
            failure = OSError(error.errno, error.strerror, str(target))
            # the name exists, or another process removed it before it was locked; or the folder does not exist
            if not isinstance(error, FileExistsError | FileNotFoundError):
                break
            continue
        if _lock(handle) is not False and _is(handle, path):
            return path, handle
        os.close(handle)
        _remove(path)
    raise failure


def _make(path: Path, *, folder: bool) -> int:
    """A handle on a new file or folder."""
    if not folder:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    path.mkdir(mode=0o700)
    return os.open(path, os.O_RDONLY)


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


def _lock(handle: int) -> bool | None:
    """Whether the lock was acquired; None if the file system does not support locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is(handle: int, path: Path) -> bool:
    """Whether the path refers to the handle's file."""
    with suppress(OSError):
        return os.path.samestat(os.fstat(handle), path.lstat())
    return False


def _remove_unheld(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if os.fstat(handle).st_uid == os.geteuid() and _lock(handle) and _is(handle, path):
            _remove(path)
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
        raise InputError(f"{path}: cannot be written: {told(error)}") from error
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: cannot be written: {unencodable(error)}") from error


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
