"""Functions that are compiled once for all processes."""

import os
import subprocess
import sys
from pathlib import Path

CODE = """
from factors.compiled import compiled

@compiled
def inner(x):
    return x + 1.0

@compiled(error_model="numpy")
def outer(x):
    return 1.0 / inner(x)
"""
CALL = "import kernels; assert kernels.outer(1.0) == 0.5; print(sum(kernels.outer.stats.cache_misses.values()))"
PATIENT = "import factors.compiled; factors.compiled.PATIENCE = 1e9; "  # who waits without need does not end
REFUSED = """
import os
real = os.open
def refused(path, *rest):
    if str(path).endswith("compiling.lock"):
        raise PermissionError(path)
    return real(path, *rest)
os.open = refused
"""
# numba's own cache, with a lock kept as by a process that is stuck while it compiles
STUCK = "import time, kernels; kernels.inner._cache._lock(); print('has it', flush=True); time.sleep(600.0)"


def started(folder: Path, code: str, **environment: str) -> subprocess.Popen[str]:
    file = folder / "kernels.py"
    if not file.exists():  # a file that is written anew is compiled anew
        file.write_text(CODE)
    path = os.pathsep.join((str(folder), *filter(None, sys.path)))
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(folder / "cache"), **environment},
        stdout=subprocess.PIPE,
        text=True,
    )


def test_of_processes_that_need_a_function_at_once_one_compiles_it(tmp_path: Path) -> None:
    processes = [started(tmp_path, CALL) for _ in range(2)]
    assert sorted(process.communicate()[0].strip() for process in processes) == ["0", "1"]


def test_a_process_that_ends_while_it_compiles_is_waited_for_no_longer(tmp_path: Path) -> None:
    stuck = started(tmp_path, STUCK)
    assert stuck.stdout is not None
    stuck.stdout.readline()
    waiting = started(tmp_path, PATIENT + CALL)
    try:
        waiting.wait(5.0)
    except subprocess.TimeoutExpired:  # as it should be
        stuck.kill()
    assert waiting.communicate(timeout=100.0)[0].strip() == "1"
    stuck.communicate()


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(tmp_path: Path) -> None:
    process = started(tmp_path, CALL, NUMBA_CACHE_LOCATOR_CLASSES="ZipCacheLocator")
    assert process.communicate()[0].strip() == "1"
    assert process.returncode == 0
    assert not (tmp_path / "cache").exists()


def test_locks_of_somebody_else_are_not_waited_for(tmp_path: Path) -> None:
    process = started(tmp_path, REFUSED + PATIENT + CALL)
    assert process.communicate(timeout=100.0)[0].strip() == "1"
