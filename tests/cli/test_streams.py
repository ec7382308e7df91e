"""The command with standard output and standard error of all kinds. Where the interpreter's own end counts, a case is a process."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

FGLOC = f"{sys.executable} -c 'from factorgraph_loc.cli.main import main; main()'"
REFUSED = "error: standard output: cannot be written: "


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """What a shell makes of ``fgloc`` with ``line``."""
    command = f"set -o pipefail; {FGLOC} {line}"
    environment = {**os.environ, **environment}
    return subprocess.run(["bash", "-c", command], capture_output=True, check=False, env=environment, timeout=60)


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


def test_file_names_of_all_kinds_are_told(refused: Callable[..., str], tmp_path: Path) -> None:
    said = refused("info", tmp_path / os.fsdecode(b"caf\xe9 \x1b[31mred \xe2\x80\xae"))
    assert "caf\\udce9 \\x1b[31mred \\u202e" in said
    assert said.isprintable()
