"""Reading of files within limits of size and time, and without the messages that C and Rust libraries print about damaged ones.

All files are opened here: only regular files, because a FIFO blocks and a device never ends. Sizes, including declared ones, are
checked before memory is allocated. libpng and libjpeg ignore OpenCV's log level; polars prints from its threads before it raises.
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

SETTINGS = 16 * 2**20  # bytes of a TOML or JSON file
YAML = 2**16  # bytes of a YAML file, which is a hundred times slower to read
DEFINITION = 2**20  # characters of the definition of a ROS message, which is compiled to functions
DATA = 2**30  # bytes of a table, a text or a MATLAB file, packed and unpacked
IMAGE = 2**28  # bytes of an image's file
GRID = 2**26  # bytes of a grid, unpacked
PIXELS = 2**26  # of an image; the limit of OpenCV is 2^30
CELLS = 2**27  # rows times columns that a Parquet file declares
MEMORY, MEMORY_PER_BYTE = 2**30, 32  # bytes that reading a file may take, and in addition for each byte of the file
CHECK_INTERVAL = 0.01  # s between checks of the memory
LARGEST_POINTER = 1024  # bytes, as its specification says

_limited = threading.Event()  # whether this process limits the memory that reading a file takes
POINTER = b"version https://git-lfs.github.com/spec/v1"  # first line of what Git LFS leaves in place of a file
_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class NoFileNameError(InputError):
    """A name that no file can have."""


def kind(path: Path, source: object = None) -> str:
    """The kind of a path: "a file", "a folder", "a named pipe", "a socket", "a device", or "" if nothing exists.

    NoFileNameError if no file can have that name, InputError if access is denied; ``source`` is named in messages, by default the
    path.
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
    """InputError if ``size``, in bytes or as ``what`` says, exceeds ``limit``; call this before allocating memory."""
    if not 0 <= size <= limit:
        raise InputError(f"{plain(source)}: {what} is {size:,}, expected at most {limit:,}")


@contextmanager
def opened(path: Path, limit: int) -> Iterator[BinaryIO]:
    """Open a regular file of at most ``limit`` bytes for reading; InputError if that is impossible."""
    if kind_of_path := kind(path):
        _require_file(path, kind_of_path)
    try:
        # non-blocking, in case a FIFO has replaced the file since
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
    """The content of a regular file of at most ``limit`` bytes; InputError as in :func:`opened`."""
    with opened(path, limit) as file:
        try:
            content = file.read()
        except OSError as error:
            raise InputError(f"{plain(path)}: cannot be read: {error.strerror}") from error
    require_size(path, "its size in bytes", len(content), limit)  # it may have grown
    return content


def copy_file(source: Path, target: Path) -> None:
    """Copy the regular file ``source`` to the new file ``target``. InputError if ``source`` cannot be read, OSError if ``target``
    cannot be written."""
    with opened(source, sys.maxsize) as file, target.open("xb") as copy:
        shutil.copyfileobj(file, copy, 2**20)


@contextmanager
def foreign(source: object, what: str) -> Iterator[None]:
    """Convert any exception of another library on invalid content to an InputError that says ``what`` the file is not.

    Use it for calls of parsers only. They raise nearly anything on damaged files: numpy tokenize.TokenError, zlib its own error,
    polars PanicException, which is not an Exception.
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
            raise  # a signal
        raise InputError(f"{plain(source)}: {what}: {error_text(error)}") from error


def limit_memory() -> None:
    """From now on, end this process where reading a file takes too much memory; see :func:`limited_memory`. For commands."""
    _limited.set()


@contextmanager
def limited_memory(source: object, size: int) -> Iterator[None]:
    """End a command with one line if this block, which reads ``source`` of ``size`` bytes, takes more than :data:`MEMORY`.

    A few kilobytes may unpack to gigabytes, and polars does not report the size in advance. A limit of the operating system is no
    alternative: compiled parsers abort without a message if memory is refused.
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
    """Resident memory of a process in bytes; 0 if unknown."""
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
    """Discard writes to descriptor 2 in this block; only in the main thread, otherwise it has no effect.

    The descriptor is shared by all threads, so their messages are lost too. Therefore a block should contain only the call that
    reads one file. In several threads, such blocks could leave the descriptor redirected for good.
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
