"""The command with standard output and standard error of all kinds. Each case is a process, as the interpreter's own end counts."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry.measurement import IncrementStream

NAME = "Gärtnerstraße ± 廊下 🤖"
FGLOC = f"{sys.executable} -c 'from factorgraph_loc.cli.main import main; main()'"
REFUSED = "error: standard output: cannot be written: "


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """What a shell makes of ``fgloc`` with ``line``."""
    command = f"set -o pipefail; {FGLOC} {line}"
    environment = {**os.environ, **environment}
    return subprocess.run(["bash", "-c", command], capture_output=True, check=False, env=environment, timeout=60)


@pytest.fixture(scope="module")
def named_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a log with a name that ASCII does not have."""
    t = np.arange(200) * 0.1
    odometry = IncrementStream(t, np.full(200, 0.05), np.zeros(200), np.zeros(200))
    folder = tmp_path_factory.mktemp("logs") / "named"
    write_native(Log(NAME, Rig(sensors=("odometry",)), World(), {"odometry": odometry}, None), folder)
    return folder


@pytest.mark.parametrize(
    ("arguments", "to", "why", "unbuffered"),
    [
        ("datasets --json", ">/dev/full", "No space left on device", ""),
        ("--help", ">/dev/full", "No space left on device", "1"),
        ("--help", ">&-", "Bad file descriptor", ""),  # the interpreter opens no stream that might have a buffer
    ],
)
def test_output_that_cannot_be_written_is_one_line(arguments: str, to: str, why: str, unbuffered: str) -> None:
    done = shell(f"{arguments} {to}", PYTHONUNBUFFERED=unbuffered)
    assert done.stderr.decode() == f"{REFUSED}{why}\n"
    assert done.returncode == 2


@pytest.mark.parametrize("to", ["2>/dev/full", "2>&- <&- >&-"])
def test_messages_that_cannot_be_written_change_no_exit_code(to: str) -> None:
    done = shell(f"info nowhere {to}", PYTHONUNBUFFERED="")
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")


def test_who_reads_no_further_ends_the_command_quietly() -> None:
    done = shell("--help | (exec <&-)")
    assert done.stderr == b""
    assert done.returncode == 141


def test_file_names_of_all_kinds_are_told(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9 \x1b[31mred \xe2\x80\xae")
    command = ["bash", "-c", f'{FGLOC} info "$1"', "-", str(path)]
    done = subprocess.run(command, capture_output=True, check=False, timeout=60)
    assert done.returncode == 2
    told = done.stderr.decode()
    assert "caf\\udce9 \\x1b[31mred \\u202e" in told
    assert told.removesuffix("\n").isprintable()


def test_a_full_disk_is_one_line_and_leaves_nothing(named_log: Path, tmp_path: Path) -> None:
    """The limit is on the size of files; Python ignores its signal, so that writing fails as on a full disk."""
    command = f"ulimit -f 1; {FGLOC} convert {named_log} {tmp_path}/out"
    done = subprocess.run(["bash", "-c", command], capture_output=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.decode().count("\n") == 1
    assert "File too large" in done.stderr.decode()
    assert list(tmp_path.iterdir()) == []
