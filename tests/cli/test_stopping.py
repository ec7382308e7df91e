"""Commands that a signal ends: with one line, an exit code, and nothing left behind; after `kill -9` the same command goes on."""

import os
import signal
import subprocess
import sys

import pytest

from .conftest import COMMAND

LINES = {signal.SIGINT: "interrupted\n", signal.SIGTERM: "terminated\n", signal.SIGHUP: "hung up\n"}


def compare(processes, out, short_log, **options):
    """A comparison of two runs in a process of their own, of which the first is soon done and the second never."""
    endless = ("--set", "particle_filter.particles=1000000")
    line = ("compare", short_log, "-e", "dead_reckoning,particle_filter", "-o", out, "--jobs", 1, *endless)
    running = processes.start(*COMMAND, *line, **options)
    processes.wait_until(lambda: list(out.glob("store/*/*/metrics.json")) and len(processes.of_group(running.pid)) > 1)
    return running


def temporary(folder):
    return [path for path in folder.rglob(".*") if ".fgloc-" in path.name]


def hang_up_ignored():
    """As ``nohup`` starts a command."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


def test_a_signal_ends_a_comparison_with_its_processes(processes, short_log, tmp_path):
    """A signal that is ignored from the start stays so."""
    running = compare(processes, tmp_path / "out", short_log, stderr=subprocess.PIPE, preexec_fn=hang_up_ignored)
    os.kill(running.pid, signal.SIGHUP)
    os.kill(running.pid, signal.SIGTERM)
    said = running.communicate(timeout=processes.PATIENCE)[1].splitlines(keepends=True)
    # the first use of the package in an environment announces that it compiles functions
    ending = [line for line in said if "compiles functions" not in line]
    assert (running.returncode, ending) == (128 + signal.SIGTERM, [LINES[signal.SIGTERM]])
    processes.wait_until(lambda: not processes.of_group(running.pid))
    assert temporary(tmp_path) == []


def test_a_killed_comparison_leaves_no_process_and_can_be_made_again(processes, short_log, tmp_path, fgloc):
    running = compare(processes, tmp_path / "out", short_log)
    os.kill(running.pid, signal.SIGKILL)
    running.wait()
    processes.wait_until(lambda: not processes.of_group(running.pid))
    other = fgloc("compare", short_log, "-e", "dead_reckoning", "-o", tmp_path / "out")
    assert other.exit_code == 0, other.output
    assert temporary(tmp_path) == []
    assert [list((tmp_path / "out" / "store" / name).iterdir()) for name in ("tmp", "claims")] == [[], []]


# in a process of its own: a test runner would take the exception for its own interrupt
DESTRUCTOR = """
import signal

from factorgraph_loc.cli.stopping import Stop, stoppable

class Slow:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)
        print("goes on")

try:
    with stoppable():
        slow = Slow()
        del slow
        signal.pause()
except Stop as stop:
    print(stop.number.name, signal.getsignal(signal.SIGTERM).name)
"""


def test_a_signal_is_not_lost_in_a_destructor(processes):
    running = processes.start(sys.executable, "-c", DESTRUCTOR, stdout=subprocess.PIPE)
    assert running.communicate(timeout=processes.PATIENCE)[0] == "SIGTERM SIG_DFL\n"


IMPORTING = """
import signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == {module!r}:
            sys.meta_path.remove(self)
            {send}
sys.modules.pop({module!r}, None)
sys.meta_path.insert(0, Finder())
from factorgraph_loc.cli.main import main
sys.argv[1:] = ["datasets"]
main()
"""
SEND = "signal.raise_signal(signal.SIGINT)"
HANG_UP = "signal.raise_signal(signal.SIGHUP)"
WRAP = """
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt as stop:
                raise ImportError("initialization failed") from stop
"""


@pytest.mark.parametrize(
    ("module", "send", "how"),
    [
        ("factorgraph_loc.cli.stopping", SEND, signal.SIGINT),
        ("typer", SEND, signal.SIGINT),
        ("factorgraph_loc.cli.scoring", WRAP, signal.SIGINT),
        ("numpy", WRAP, signal.SIGINT),
        ("factorgraph_loc.cli.app", HANG_UP, signal.SIGHUP),
    ],
)
def test_a_signal_while_modules_are_imported(module, send, how, processes):
    """Of modules that the command imports itself: the interpreter sends the signal as it looks for one of them."""
    code = IMPORTING.format(module=module, send=send)
    running = processes.start(sys.executable, "-c", code, stderr=subprocess.PIPE)
    assert running.communicate(timeout=processes.PATIENCE)[1] == LINES[how]
    assert running.returncode == 128 + how
