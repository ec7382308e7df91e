"""Temporary files and folders, which lie beside what they become, all in one place.

Their names are that of what they become between a dot and :data:`MARK` with eight digits. Who writes one holds a lock on it, which
the system lets go of when its process ends, however it ends. What nobody holds is swept away when a command that writes to the same
folder begins.
"""

import fcntl
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MARK = ".fgloc-"
_NAME = re.compile(rf"\..*{re.escape(MARK)}[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)
_NAMED, _SUFFIX = 150, 60  # bytes that are taken of a name, and that a suffix may have: file systems have 255 for all
_swept: set[Path] = set()  # folders that this process has looked through
_own: set[Path] = set()  # what this process has made and not removed


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """An empty file beside ``path``, with its suffix; it is removed when the block ends, if it has not got another name by then."""
    with _held(path, path.stem, path.suffix, folder=False) as made:
        yield made


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """A new folder beside ``path``, for this user alone; it is removed when the block ends, with what is in it."""
    with _held(path, path.name, "", folder=True) as made:
        yield made


def of_system(name: str) -> Path:
    """A path of that name where the system keeps what is temporary."""
    return Path(tempfile.gettempdir()) / name


def sweep(folder: Path) -> None:
    """Remove what is temporary in ``folder``, is this user's, and belongs to no process that lives."""
    with suppress(OSError):  # there is no such folder
        for entry in os.scandir(folder):
            if _NAME.fullmatch(entry.name):
                with suppress(OSError):  # it is held, or another process was faster
                    _remove_unheld(folder / entry.name)


def remove_own() -> None:
    """Remove all that this process has made and not removed, because a signal came between."""
    for path in list(_own):
        _remove(path)


@contextmanager
def _held(path: Path, name: str, suffix: str, *, folder: bool) -> Iterator[Path]:
    if path.parent not in _swept:
        _swept.add(path.parent)
        sweep(path.parent)
    start = "." + os.fsencode(name)[:_NAMED].decode(errors="ignore") + MARK
    ending = suffix if len(os.fsencode(suffix)) <= _SUFFIX else ""
    made, handle = None, None
    while handle is None:
        made = path.parent / f"{start}{secrets.token_hex(4)}{ending}"
        handle = _make(made, folder=folder)
    assert made is not None
    try:
        yield made
    finally:
        _remove(made)
        os.close(handle)


def _make(path: Path, *, folder: bool) -> int | None:
    """A handle on what was made under this name; None where there is something, or another process swept it before it was held."""
    _own.add(path)
    try:
        if folder:
            path.mkdir(mode=0o700)
            handle = os.open(path, os.O_RDONLY)
        else:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        _own.discard(path)
        if isinstance(error, FileExistsError) or (isinstance(error, FileNotFoundError) and path.parent.is_dir()):
            return None
        raise
    if _lock(handle) is not False and _is(handle, path):
        return handle
    os.close(handle)
    _remove(path)
    return None


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait until no other process is in such a block, by a lock on the file ``path``, which stays there; where the file system has
    no locks, nobody waits."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _lock(handle: int) -> bool | None:
    """Whether the lock is ours; None where the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is(handle: int, path: Path) -> bool:
    """Whether the path is still that of what the handle is on."""
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
