"""Temporary files and folders: gone when they are done with, and when who wrote them is gone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from factorgraph_loc.files import temporary
from factorgraph_loc.files.models import replacing, write_text
from factorgraph_loc.files.temporary import locked, remove_own, sweep, temporary_file, temporary_folder

HOLDER = """
import os, sys, time
from pathlib import Path

from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.temporary import temporary_folder

folder = Path(sys.argv[1])
with replacing(folder / "map.world.toml") as one, temporary_folder(folder / "log") as two:
    one.write_text("half")
    (two / "odometry.csv").write_text("half")
    os.mkdir(folder / "ready")
    time.sleep(600)
"""


@pytest.fixture(autouse=True)
def _another_start(monkeypatch):
    """Each folder is looked through as by a process that has just begun."""
    monkeypatch.setattr(temporary, "_swept", set())


def hidden(folder):
    return {path.name for path in folder.iterdir() if path.name.startswith(".")}


@pytest.mark.parametrize("name", ["map.world.toml", "table.parquet", "ä" * 120 + ".png", "x." + "y" * 240, "a\nb.csv"])
def test_names_say_what_it_becomes(name, tmp_path):
    with temporary_file(tmp_path / name) as file, temporary_folder(tmp_path / name) as folder:
        assert file.name.startswith(f".{name[:1]}")
        assert hidden(tmp_path) == {file.name, folder.name}
        sweep(tmp_path)
        assert hidden(tmp_path) == {file.name, folder.name}
        if len(name) < 20:
            assert file.suffix == Path(name).suffix
    assert hidden(tmp_path) == set()


def test_what_fails_leaves_nothing_behind(tmp_path):
    (tmp_path / "a.txt").write_text("before")
    with pytest.raises(UnicodeEncodeError), replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("half \udc80")
    with pytest.raises(FileNotFoundError):
        write_text(tmp_path / "no" / "a.txt", "nowhere")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "before"


def test_what_a_killed_process_has_left_is_swept_and_what_a_living_one_holds_is_not(tmp_path, processes):
    holder = processes.start(sys.executable, "-c", HOLDER, tmp_path)
    processes.wait_until((tmp_path / "ready").exists)
    assert len(hidden(tmp_path)) == 2
    sweep(tmp_path)
    assert len(hidden(tmp_path)) == 2
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert len(hidden(tmp_path)) == 2
    write_text(tmp_path / "other.txt", "whole")  # whatever is written there next
    assert hidden(tmp_path) == set()


def test_files_of_others_are_left_alone(tmp_path):
    machine, gone = temporary._MACHINE, 2**22 + 1  # more than Linux gives
    names = [f".a.fgloc-{machine}-{gone}-1234567", f"a.fgloc-{machine}-{gone}-12345678", ".a.fgloc-12345678"]
    names += [f".a.fgloc-{machine}-{os.getppid()}-12345678", f".a.fgloc-{machine}-{gone}-12345678.b.c"]
    names += [f".a.fgloc-00000000-{gone}-12345678"]
    for name in names:
        (tmp_path / name).write_text("mine")
    (tmp_path / "target").mkdir()
    (link := tmp_path / f".link.fgloc-{machine}-{gone}-12345678").symlink_to(tmp_path / "target")
    os.mkfifo(tmp_path / f".pipe.fgloc-{machine}-{gone}-12345678")
    sweep(tmp_path)
    assert {*names, link.name} <= {path.name for path in tmp_path.iterdir()}
    os.utime(tmp_path / names[-1], (0.0, 0.0))  # of a machine that has forgotten it
    sweep(tmp_path)
    assert not (tmp_path / names[-1]).exists()
    sweep(tmp_path / "target" / "no such folder")


def test_what_a_signal_left_is_removed_at_the_end(tmp_path):
    held = temporary_folder(tmp_path / "log")
    folder = held.__enter__()
    (folder / "odometry.csv").write_text("half")
    remove_own()
    assert hidden(tmp_path) == set()
    held.__exit__(None, None, None)


LOCKER = """
import sys
from pathlib import Path

from factorgraph_loc.files.temporary import locked

count = Path(sys.argv[1]) / "count"
for _ in range(50):
    with locked(count.with_name("lock")):
        count.write_text(str(int(count.read_text()) + 1))
"""


def test_a_lock_lets_one_process_in_at_a_time(tmp_path, processes):
    (tmp_path / "count").write_text("0")
    others = [processes.start(sys.executable, "-c", LOCKER, tmp_path) for _ in range(3)]
    assert [other.wait() for other in others] == [0, 0, 0]
    assert (tmp_path / "count").read_text() == "150"
    with locked(tmp_path / "lock"):
        pass


def test_an_error_without_a_file_gets_the_name_of_the_target(tmp_path):
    with pytest.raises(OSError, match="No space left") as caught, replacing(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a.txt")


IN_ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
WRITER = """
import os, sys
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing

write_text(Path(sys.argv[1]), "whole")
try:
    with writing("out"):
        write_text(Path(os.path.dirname(sys.argv[1]), "\\xe4.txt"), "")
except InputError as error:
    print(ascii(str(error)))
"""


def test_names_beyond_ascii_in_a_system_without_them(tmp_path):
    path = tmp_path / "büro" / "ü.txt"
    path.parent.mkdir()
    command = [sys.executable, "-c", WRITER, path]
    done = subprocess.run(command, env=os.environ | IN_ASCII, capture_output=True, check=True)
    told = "out: cannot be written: 'ä' cannot be written in ascii, the encoding of this system: set PYTHONUTF8=1"
    assert done.stdout.decode().strip() == ascii(told)
    assert path.read_text() == "whole"
