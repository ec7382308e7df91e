"""Functions compiled by numba. Their code is kept in files, and where several processes need a function that is not there yet, one
compiles it and the others wait for it."""

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

PATIENCE = 60.0  # s; then a process compiles what another seems to be stuck with
_BEAT = 0.02  # s

Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def compiled(function: Function, /) -> Function: ...


@overload
def compiled(**options: Any) -> Callable[[Function], Function]: ...


def compiled(function: Any = None, /, **options: Any) -> Any:
    """``numba.njit`` with these options. The code is cached next to the function's file, else in the user's cache folder. If
    neither is writable, each process compiles the function."""
    if function is None:
        return lambda decorated: _compiled(decorated, options)
    return _compiled(function, options)


def _compiled(function: Any, options: dict[str, Any]) -> Any:
    # C code never calls it: no wrapper is needed, which numba would compile too
    made = numba.njit(**{"no_cfunc_wrapper": True, **options})(function)
    with suppress(RuntimeError):  # there is no place for it
        made._cache = _Shared(function)  # what `cache=True` does with numba's own class
    return made


class _Shared(FunctionCache):
    """A cache that keeps a lock from when a function is not found until it is saved. A function locks those that it calls while it
    is locked itself, which is no circle. Locks end with their process."""

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
        except OSError:  # it belongs to somebody else
            return
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                fcntl.lockf(locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._place())
                return
            except (BlockingIOError, PermissionError):  # another process has it
                time.sleep(_BEAT)
            except OSError:  # a file system without locks
                return

    def _unlock(self) -> None:
        try:
            fcntl.lockf(_locks(self.cache_path), fcntl.LOCK_UN, 1, self._place())
        except OSError:
            return

    def _place(self) -> int:
        """The byte that is locked, of a file that all functions of a folder have in common."""
        return zlib.crc32(self._impl.filename_base.encode())


@cache
def _locks(folder: str) -> int:
    """An open file of a folder, for locks. It stays open, because closing it releases all locks."""
    return os.open(Path(folder) / "compiling.lock", os.O_RDWR | os.O_CREAT, 0o666)
