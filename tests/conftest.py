"""What several tests share."""

import gc
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from factorgraph_loc.threads import use_one_thread

# before numpy is imported, as commands do: two threads spend most of their time waiting for each other, ten times the work itself
use_one_thread()
gc.set_threshold(50_000)  # as the command does: a search through all that the tests import takes a third of a second
# the same examples on each run; no deadline, as the first call of a compiled function takes seconds
settings.register_profile("seeded", derandomize=True, deadline=None)
# many other examples on each run, for `pytest tests/fuzz --hypothesis-profile=long`
settings.register_profile("long", max_examples=10_000, deadline=None, suppress_health_check=list(HealthCheck))
settings.load_profile("seeded")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Features that tests find are not put into the user's cache, nor taken from it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FGLOC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of recorded data; the test is skipped where it is absent."""
    folder = os.environ.get("FGLOC_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("FGLOC_DATA names no folder of recorded data")
    return Path(folder)


class Processes:
    """Starts processes, and looks at them."""

    PATIENCE = 100.0  # s: other tests may keep all processors busy

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *command: object, **options: object) -> subprocess.Popen[str]:
        """A process that leads a group, as a shell starts it: signals that this process ignores are not ignored there."""
        words = [str(word) for word in command]
        begin = {"start_new_session": True, "preexec_fn": _ordinary_signals, "text": True} | options
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, **begin)
        self._started.append(process)
        return process

    def end(self) -> None:
        """End all of them, with their groups."""
        for process in self._started:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Wait for a condition; it is an error if it never comes."""
        until = time.monotonic() + self.PATIENCE
        while not condition():
            assert time.monotonic() < until
            time.sleep(0.02)

    def lives(self, pid: int) -> bool:
        """Whether a process runs; one that has ended may not have been buried."""
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
        except OSError:
            return False

    def of_group(self, leader: int) -> list[int]:
        """The processes of a group that run."""
        found = []
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                state, _, group = path.read_text().rpartition(")")[2].split()[:3]
            except OSError:
                continue
            if int(group) == leader and state not in "ZX":
                found.append(int(path.parent.name))
        return found


def _ordinary_signals() -> None:
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(one, signal.SIG_DFL)


@pytest.fixture
def processes() -> Iterator[Processes]:
    """``processes.start(command, ...)``: a process that is ended with the test."""
    those = Processes()
    yield those
    those.end()
