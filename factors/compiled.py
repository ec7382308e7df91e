"""Compilation of functions by numba, with a cache on disk that several processes share. If several processes need a
function that is not in the cache, one compiles the function and the rest wait."""

import fcntl
import os
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
from numba.core.caching import FunctionCache

PATIENCE = 60.0  # s; a process that has waited this long compiles the function itself
_BEAT = 0.02  # s; interval between attempts to get the lock

Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def compiled(function: Function, /) -> Function: ...


@overload
def compiled(**options: Any) -> Callable[[Function], Function]: ...


def compiled(function: Any = None, /, **options: Any) -> Any:
    """Compile a function with ``numba.njit`` and these ``options``. Use it as a decorator, with or without arguments.

    The compiled code is cached next to the function's file. If that folder is not writable, it is cached in the user's
    cache folder. If neither is writable, each process compiles the function.
    """
    if function is None:
        return lambda decorated: _compiled(decorated, options)
    return _compiled(function, options)


def _compiled(function: Any, options: dict[str, Any]) -> Any:
    # without the wrapper for calls from C, which nobody uses, numba compiles faster
    made = numba.njit(**{"no_cfunc_wrapper": True, **options})(function)
    with suppress(RuntimeError):  # no folder for the cache is writable
        made._cache = _Shared(function)  # the option `cache=True` does the same with numba's own class
    return made


class _Shared(FunctionCache):
    """A cache of one function's compiled code with a lock between processes.

    A process that does not find the code locks the function, compiles it, saves the code, and releases the lock. It may
    also lock the functions that this function calls. Deadlocks are impossible, because compiled functions do not call
    each other in a circle. The operating system releases the locks of a process that ends.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        code = super().load_overload(sig, target_context)
        if code is None:
            self._lock()
            code = super().load_overload(sig, target_context)  # another process may have saved it in the meantime
            if code is not None:
                self._unlock()
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            with suppress(OSError):  # the disk is full
                super().save_overload(sig, data)
        finally:
            self._unlock()

    def _lock(self) -> None:
        try:
            locks = _locks(self.cache_path)
        except OSError:  # the lock file is not writable, because another user owns it
            return
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                fcntl.lockf(locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._place())
                return
            except (BlockingIOError, PermissionError):  # another process has the lock
                time.sleep(_BEAT)
            except OSError:  # a file system without locks
                return

    def _unlock(self) -> None:
        try:
            fcntl.lockf(_locks(self.cache_path), fcntl.LOCK_UN, 1, self._place())
        except OSError:
            return

    def _place(self) -> int:
        """Return the offset of this function's byte in the lock file. The functions of a folder share one lock file."""
        return zlib.crc32(self._impl.filename_base.encode())


@cache
def _locks(folder: str) -> int:
    """Return the file descriptor of a folder's lock file. It stays open, because closing it releases all locks."""
    return os.open(Path(folder) / "compiling.lock", os.O_RDWR | os.O_CREAT, 0o666)
