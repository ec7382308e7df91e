"""Reading of files within limits of size and memory, without the messages that C and Rust libraries print about damaged files.

All input files are opened by this module. They must be regular files, because a FIFO blocks and a device never ends.
The size of a file, and sizes that its header declares, are checked before memory is allocated. Messages of libraries
are suppressed at the file descriptor of stderr, because libpng, libjpeg and polars print at any log level.
"""

import errno
import os
import shutil
import stat
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.text import error_text, plain, quoted

SETTINGS = 16 * 2**20  # maximum bytes of a TOML or JSON file
YAML = 2**16  # maximum bytes of a YAML file, which is a hundred times slower to read than TOML
DEFINITION = 2**20  # maximum characters of the definition of a ROS message
DATA = 2**30  # maximum bytes of a table, a text or a MATLAB file, compressed and uncompressed
IMAGE = 2**28  # maximum bytes of an image file
GRID = 2**26  # maximum bytes of an uncompressed occupancy grid
PIXELS = 2**26  # maximum pixels of an image; the limit of OpenCV is 2^30
CELLS = 2**27  # maximum product of the numbers of rows and columns of a Parquet file
MEMORY, MEMORY_PER_BYTE = 2**30, 32  # reading a file of N bytes may take MEMORY + MEMORY_PER_BYTE * N bytes of memory
CHECK_INTERVAL = 0.01  # s between checks of the memory
LARGEST_POINTER = 1024  # maximum bytes of a pointer file of Git LFS, by its specification

_limited = threading.Event()  # set if this process limits the memory that reading a file takes
POINTER = b"version https://git-lfs.github.com/spec/v1"  # first line of a pointer file of Git LFS
_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class NoFileNameError(InputError):
    """A name cannot be the name of a file, because it is too long or contains an invalid character."""


def kind(path: Path, source: object = None) -> str:
    """Return the kind of a path, such as "a file", "a folder", "a named pipe", or "" if nothing exists there.

    ``source``: the file or option that contains the path, for messages. Raises NoFileNameError if no file can have this
    name, and InputError if access is denied.
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
    except ValueError as error:  # a NUL character, or half of a UTF-16 surrogate pair
        raise NoFileNameError(f"{source or plain(path)}: {quoted(str(path))} cannot be the name of a file") from error


def require_size(source: object, what: str, size: int, limit: int) -> None:
    """Raise InputError if ``size`` exceeds ``limit``. Call this before memory of that size is allocated.

    ``source``: the file. ``what``: the quantity that ``size`` measures, such as "its size in bytes"; both are for the message.
    """
    if not 0 <= size <= limit:
        raise InputError(f"{plain(source)}: {what} is {size:,}, expected at most {limit:,}")


@contextmanager
def opened(path: Path, limit: int) -> Iterator[BinaryIO]:
    """Open a regular file of at most ``limit`` bytes for reading in this block.

    Raises InputError if the file is missing, not regular, larger, unreadable, or a pointer file of Git LFS.
    """
    if kind_of_path := kind(path):
        _require_file(path, kind_of_path)
    try:
        # non-blocking: a FIFO may have replaced the file after the check
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb")
    except OSError as error:
        raise InputError(f"{plain(path)}: cannot be read: {error.strerror}") from error
    with file:
        now = os.fstat(file.fileno())
        _require_file(path, _kind(now))
        require_size(path, "its size in bytes", now.st_size, limit)
        if now.st_size < LARGEST_POINTER and os.pread(file.fileno(), len(POINTER), 0) == POINTER:
            raise InputError(f"{plain(path)}: is a pointer of Git LFS, not the file: `git lfs pull` fetches it")
        yield file


def read_bytes(path: Path, limit: int) -> bytes:
    """Return the content of a regular file. Raises InputError if it is missing, or larger than ``limit`` bytes."""
    with opened(path, limit) as file:
        try:
            content = file.read()
        except OSError as error:
            raise InputError(f"{plain(path)}: cannot be read: {error.strerror}") from error
    require_size(path, "its size in bytes", len(content), limit)  # the file may have grown since it was opened
    return content


def copy_file(source: Path, target: Path) -> None:
    """Copy the regular file ``source`` to the new file ``target``. Raises InputError if ``source`` cannot be read, and
    OSError if ``target`` exists or cannot be written."""
    with opened(source, sys.maxsize) as file, target.open("xb") as copy:
        shutil.copyfileobj(file, copy, 2**20)


@contextmanager
def foreign(source: object, what: str) -> Iterator[None]:
    """Convert any exception of a parser in this block to an InputError with the message "SOURCE: WHAT: ...".

    ``source``: the file. ``what``: the problem, such as "is not TOML". The block should contain only the call of the
    parser. On damaged files parsers raise unusual exceptions: numpy tokenize.TokenError, zlib its own error, and polars
    PanicException, which does not derive from Exception.
    """
    try:
        yield
    except FglocError:
        raise
    except MemoryError as error:
        raise InputError(f"{plain(source)}: {what}: it needs more memory than is available") from error
    except RecursionError as error:
        raise InputError(f"{plain(source)}: {what}: it is nested too deeply") from error
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__module__ != "pyo3_runtime":
            raise  # KeyboardInterrupt, SystemExit or the like
        raise InputError(f"{plain(source)}: {what}: {error_text(error)}") from error


def limit_memory() -> None:
    """Enable :func:`limited_memory`, which is off by default for programs that import the package."""
    _limited.set()


@contextmanager
def limited_memory(source: object, size: int) -> Iterator[None]:
    """End the process with a message on stderr if this block takes more memory than a valid file needs.

    ``source``: the file that the block reads. ``size``: its size in bytes. The limit is :data:`MEMORY` plus
    :data:`MEMORY_PER_BYTE` times ``size``. It applies only after a call of :func:`limit_memory`.
    """
    if not _limited.is_set():
        yield
        return
    most = MEMORY + MEMORY_PER_BYTE * size
    limit = resident_memory(os.getpid()) + most
    done, errors = threading.Event(), os.dup(2)

    def watch() -> None:
        while not done.wait(CHECK_INTERVAL):
            if resident_memory(os.getpid()) > limit:
                text = f"error: {plain(source)}: reading it takes more than {most / 1e6:,.0f} MB of memory\n"
                os.write(errors, text.encode(errors="backslashreplace"))
                os._exit(InputError.exit_code)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        os.close(errors)


def resident_memory(pid: int | None) -> float:
    """Return the resident memory of the process with number ``pid`` in bytes, or 0 if it is unknown."""
    try:
        return float(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0.0


def _kind(status: os.stat_result) -> str:
    return _KINDS.get(stat.S_IFMT(status.st_mode), "a device")


def _require_file(path: Path, kind: str) -> None:
    if kind != "a file":
        raise InputError(f"{plain(path)}: is {kind}, expected a regular file")


@contextmanager
def quiet() -> Iterator[None]:
    """Discard all output to file descriptor 2 (stderr) in this block. Has no effect outside of the main thread.

    Output of other threads in the meantime is discarded too, so keep the block short.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        kept = os.dup(2)
    except OSError:  # the descriptor is closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
