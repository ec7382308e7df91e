import os
import socket
import time
from pathlib import Path

import pytest
from refusal import refusal

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import bounded
from factorgraph_loc.files import models as files
from factorgraph_loc.files.models import inside, parse_json, read_json, read_text, read_toml


def test_a_path_below_a_folder_follows_links_within_it(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "file").write_text("")
    (tmp_path / "b").symlink_to("a")
    assert inside(tmp_path, "b/file", "log") == tmp_path / "a" / "file"
    assert inside(tmp_path, "b/none", "log") == tmp_path / "a" / "none"
    assert inside(tmp_path, "b", "log") == tmp_path / "a"


def test_a_folder_that_is_named_through_a_link_is_the_folder(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "file").write_text("")
    (tmp_path / "log").symlink_to("disk")
    assert inside(tmp_path / "log", "file", "log").read_text() == ""


@pytest.mark.parametrize(
    "name", ["../secret", "/etc/passwd", "out", "out/passwd", "a/../../secret", "far", "a/up/secret"]
)
def test_a_path_that_leaves_its_folder_is_refused(tmp_path, name):
    root = tmp_path / "log"
    (root / "a").mkdir(parents=True)
    (tmp_path / "secret").write_text("")
    (root / "out").symlink_to("/etc")
    (root / "far").symlink_to("out")
    (root / "a" / "up").symlink_to("../..")
    by = f"{root} by a link, to " if name in ("out", "out/passwd", "far", "a/up/secret") else str(root)
    refusal(lambda: inside(root, name, "run.toml"), "run.toml: path", f"leaves its folder {by}")


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "x/" * 3000 + "y", "\ud800"])
def test_a_path_that_no_file_can_have_is_refused(tmp_path, name):
    refusal(lambda: inside(tmp_path, name, "run.toml"), "run.toml: ")
    refusal(lambda: read_text(tmp_path / name), "cannot be")


def test_a_link_to_itself_is_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    refusal(lambda: read_text(tmp_path / "a"), "cannot be read")
    refusal(lambda: inside(tmp_path, "a", "run.toml"), "run.toml: ")


@pytest.mark.parametrize("what", ["fifo", "socket", "zero", "folder"])
def test_only_regular_files_are_read(tmp_path, what):
    path = tmp_path / "it"
    match what:
        case "fifo":
            os.mkfifo(path)
        case "socket":
            here = Path.cwd()
            os.chdir(tmp_path)  # the name of a socket is short
            try:
                socket.socket(socket.AF_UNIX).bind("it")
            finally:
                os.chdir(here)
        case "zero":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
    started = time.monotonic()
    refusal(lambda: read_text(path), "it: is a", "expected a regular file")
    refusal(lambda: bounded.copy_file(path, tmp_path / "copy"), "expected a regular file")
    if what in ("fifo", "socket"):
        refusal(lambda: inside(tmp_path, "it", "run.toml"), "run.toml: path 'it' is a", "expected a regular file")
    assert time.monotonic() - started < 1.0
    assert not (tmp_path / "copy").exists()


def test_a_file_is_not_read_before_its_size_is_known_to_be_small_enough(tmp_path):
    path = tmp_path / "sparse.toml"
    with path.open("wb") as file:
        file.truncate(10**12)
    refusal(lambda: read_toml(path), "its size in bytes is 1,000,000,000,000, expected at most 16,777,216")
    refusal(lambda: read_text(path), "expected at most 1,073,741,824")


def test_a_copy_is_a_file_of_its_own(tmp_path):
    source, copy = tmp_path / "a.png", tmp_path / "b.png"
    source.write_bytes(bytes(range(256)) * 10000)
    bounded.copy_file(source, copy)
    assert copy.read_bytes() == source.read_bytes()
    with copy.open("r+b") as file:
        file.write(b"edited")
    assert source.read_bytes()[:6] == bytes(range(6))
    assert source.stat().st_nlink == 1
    with pytest.raises(FileExistsError):
        bounded.copy_file(source, copy)


def test_toml_of_other_editors_is_read(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1\r\nb = '''x\r\ny'''\r\n")
    assert read_toml(path) == {"a": 1, "b": "x\ny"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"x = " + b"9" * 5000, "is not TOML"),
        (b"x = " + b"[" * 3000 + b"]" * 3000, "nested too deep"),
        (b"x = " + b"[" * 100 + b"]" * 100, "64 tables or lists deep"),
        (b"\n" + b"a." * 100_000 + b"a = 1", "a.toml:2: a key has more than 64 parts"),
        (b"x = 1979-05-27", "x is a date"),
    ],
)
def test_what_is_no_toml_of_ours_is_one_line(tmp_path, content, words):
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    started = time.monotonic()
    refusal(lambda: read_toml(path), "a.toml", words)
    assert time.monotonic() - started < 2.0


@pytest.mark.parametrize("many", ["[[0.5, 0.5], [0.5]]", "{a = 1, b = [1.0, 2.0]}", "[1, 2, 3, 4]"])
def test_a_file_has_so_many_values_at_most(tmp_path, monkeypatch, many):
    path = tmp_path / "a.toml"
    path.write_text(f"x = {many}\n")
    monkeypatch.setattr(files, "MOST_ENTRIES", 6)
    read_toml(path)
    monkeypatch.setattr(files, "MOST_ENTRIES", 4)
    refusal(lambda: read_toml(path), "a.toml: the number of its values is", "expected at most")


def test_json_has_so_many_values_at_most(monkeypatch):
    monkeypatch.setattr(files, "MOST_ENTRIES", 10)
    assert parse_json("[1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", "a.json") == [1] * 10
    refusal(lambda: parse_json("[1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", "a.json"), "the number of its values is 11")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 5000 + "]" * 5000, "nested too deep"),
        ("9" * 5000, "5000 digits"),
        ('{"a": NaN}', "NaN"),
        ('{"a": 1, "a": 2}', "'a' is duplicate"),
        ("\ufeff1", "is not JSON"),
    ],
)
def test_what_is_no_json_of_ours_is_one_line(tmp_path, text, words):
    refusal(lambda: parse_json(text, "log.jsonl:3"), "log.jsonl:3: ", words)
    path = tmp_path / "a.json"
    path.write_text(text)
    if not text.startswith("\ufeff"):
        refusal(lambda: read_json(path), "a.json: ", words)


def test_json_keeps_integers_as_long_as_an_epc():
    assert parse_json('{"epc": 79228162514264337593543950335, "t": 1e400}', "a")["epc"] == 2**96 - 1


def test_what_another_library_raises_is_one_line():
    class Panic(BaseException):
        pass

    def fail(error: BaseException) -> None:
        with bounded.foreign("a.npz", "is no grid"):
            raise error

    refusal(lambda: fail(ValueError("first\nsecond")), "a.npz: is no grid: first")
    refusal(lambda: fail(MemoryError()), "more memory than is available")
    refusal(lambda: fail(ValueError()), "ValueError")
    refusal(lambda: fail(InputError("as it is")), "as it is")
    with pytest.raises(Panic):
        fail(Panic())
    Panic.__module__ = "pyo3_runtime"  # of libraries in Rust
    refusal(lambda: fail(Panic("index out of range")), "index out of range")


def test_a_pointer_of_git_lfs_is_named_as_such(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(InputError, match=r"a\.csv: is a pointer of Git LFS, not the file: `git lfs pull` fetches it"):
        read_text(path)
