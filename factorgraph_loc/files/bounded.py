"""What files hold, read so that no file can hold the reader up or take its memory.

All that comes from a file comes through here: only regular files are opened, as a FIFO would wait for ever and a device never
ends, and a size, be it the file's own or one that it declares, is compared with a limit before memory is taken for it.
"""

import errno
import fcntl
import os
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.text import plain, quoted, told

SETTINGS = 16 * 2**20  # bytes of a TOML or JSON file
YAML = 2**16  # bytes of a YAML file, which takes a hundred times as long to read
DEFINITION = 2**20  # letters of the definition of a ROS message, which becomes compiled functions
DATA = 2**30  # bytes of a table, a text or a MATLAB file, as it is and unpacked
IMAGE = 2**28  # bytes of an image's file
GRID = 2**26  # bytes of a grid, unpacked
PIXELS = 2**26  # of an image; OpenCV itself would take 2^30 of them
CELLS = 2**27  # rows times columns of a Parquet file
RATIO = 1000  # cells that a byte of a Parquet file may stand for

_FICLONE = 0x40049409  # ioctl of Linux: share the content of another file until either is written
_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class NoFileNameError(InputError):
    """No file can have this name."""


def kind(path: Path, source: object = None) -> str:
    """ "a file", "a folder", "a named pipe", "a socket" or "a device"; empty where nothing is.

    NoFileNameError if no file can have that name, InputError if it may not be looked at; they name ``source``, by default the path.
    """
    try:
        return _kind(path.stat())
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR):
            return ""
        if error.errno == errno.ENAMETOOLONG:
            raise NoFileNameError(
                f"{source or plain(path)}: {quoted(str(path))} cannot be the name of a file: too long"
            ) from error
        raise InputError(f"{source or plain(path)}: {quoted(str(path))} cannot be read: {error.strerror}") from error
    except ValueError as error:  # NUL, or half of a pair of UTF-16
        raise NoFileNameError(f"{source or plain(path)}: {quoted(str(path))} cannot be the name of a file") from error


def require_size(source: object, what: str, size: int, limit: int) -> None:
    """InputError if ``size``, in bytes or as ``what`` says, is above ``limit``: to be called before memory is taken."""
    if not 0 <= size <= limit:
        raise InputError(f"{plain(source)}: {what} is {size:,}, expected at most {limit:,}")


@contextmanager
def opened(path: Path, limit: int) -> Iterator[BinaryIO]:
    """A regular file of at most ``limit`` bytes for reading; InputError if it is none, is larger or cannot be opened."""
    if found := kind(path):
        _require_file(path, found)
    try:
        # without waiting, should a FIFO have taken the file's place since
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb")
    except OSError as error:
        raise InputError(f"{plain(path)}: cannot be read: {error.strerror}") from error
    with file:
        now = os.fstat(file.fileno())
        _require_file(path, _kind(now))
        require_size(path, "its size in bytes", now.st_size, limit)
        yield file


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes; InputError as of :func:`opened`."""
    with opened(path, limit) as file:
        parts, count, step = [], 0, os.fstat(file.fileno()).st_size + 1  # what is asked for is taken at once
        try:
            while count <= limit and (part := file.read(step)):
                parts.append(part)
                count += len(part)
                step = 2**16  # the file has grown, or is one of /proc that says it is empty
        except OSError as error:
            raise InputError(f"{plain(path)}: cannot be read: {error.strerror}") from error
    require_size(path, "its size in bytes", count, limit)
    return b"".join(parts)


def copy_file(source: Path, target: Path) -> None:
    """Make the new file ``target`` with the content of the regular file ``source``; the two share it until either is written, where
    the file system can do that. InputError if ``source`` cannot be read, OSError if ``target`` cannot be written."""
    with opened(source, sys.maxsize) as file, target.open("xb") as copy:
        try:
            fcntl.ioctl(copy.fileno(), _FICLONE, file.fileno())
        except OSError:  # another file system, or one whose files share nothing
            shutil.copyfileobj(file, copy, 2**20)


@contextmanager
def foreign(source: object, what: str) -> Iterator[None]:
    """Whatever another library raises at the content of a file becomes an InputError that says ``what`` the file is not.

    It is for calls of parsers alone. They raise nearly anything at damaged files: numpy tokenize.TokenError, zlib an error of its
    own, polars PanicException, which is no Exception.
    """
    try:
        yield
    except FglocError:
        raise
    except MemoryError as error:
        raise InputError(f"{plain(source)}: {what}: it takes more memory than there is") from error
    except RecursionError as error:
        raise InputError(f"{plain(source)}: {what}: it is nested too deep") from error
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__module__ != "pyo3_runtime":
            raise  # a signal
        raise InputError(f"{plain(source)}: {what}: {told(error)}") from error


def _kind(found: os.stat_result) -> str:
    return _KINDS.get(stat.S_IFMT(found.st_mode), "a device")


def _require_file(path: Path, kind: str) -> None:
    if kind != "a file":
        raise InputError(f"{plain(path)}: is {kind}, expected a regular file")
