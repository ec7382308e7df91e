"""Results on disk are whole or not there, damage is found, and two processes do not meet at one run."""

import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.store import FAILURE, MANIFEST, METRICS, TIMINGS, DamagedError, Store, StoreError
from factorgraph_loc.text import notice

KEY, OTHER = "ab" * 32, "cd" * 32
FILES = {
    METRICS: b'{"causal.position_rmse": 0.5}',
    "estimates.parquet": bytes(1000),
    TIMINGS: b'{"timing.run_seconds": 2.0}',
}


@pytest.fixture
def store(tmp_path):
    made = Store(tmp_path / "out")
    made.create()
    return made


def test_what_is_put_is_there_with_its_scores(store):
    assert store.state(KEY) == "missing"
    store.put(KEY, FILES)
    assert store.state(KEY) == "ok"
    assert store.read(KEY, METRICS) == FILES[METRICS]
    assert store.row(KEY).items() >= {("status", "ok"), ("causal.position_rmse", 0.5), ("timing.run_seconds", 2.0)}


def test_a_failure_is_a_result_with_a_reason_and_can_be_replaced(store):
    store.put(KEY, {FAILURE: b'{"kind": "timeout", "reason": "it took more than 3 s"}'})
    assert store.state(KEY) == "failed"
    assert store.row(KEY).items() >= {("status", "failed"), ("kind", "timeout"), ("reason", "it took more than 3 s")}
    store.put(KEY, FILES)
    assert store.state(KEY) == "ok"
    assert not (store.path(KEY) / FAILURE).exists()


@settings(max_examples=20)
@given(st.sampled_from([METRICS, "estimates.parquet"]), st.integers(0, 10**6), st.integers(1, 255))
def test_any_changed_byte_is_found(tmp_path_factory, name, place, change):
    store = Store(tmp_path_factory.mktemp("flipped"))
    store.create()
    store.put(KEY, FILES)
    file = store.path(KEY) / name
    content = bytearray(file.read_bytes())
    content[place % len(content)] ^= change
    file.write_bytes(content)
    assert store.state(KEY) == "damaged"
    with pytest.raises(InputError, match="damaged"):
        store.read(KEY, name)


@pytest.mark.parametrize("what", ["truncated", "gone", "no manifest", "empty manifest", "manifest of another"])
def test_gross_damage_is_found(store, what):
    store.put(KEY, FILES)
    folder = store.path(KEY)
    match what:
        case "truncated":
            (folder / "estimates.parquet").write_bytes(b"")
        case "gone":
            (folder / "estimates.parquet").unlink()
        case "no manifest":
            (folder / MANIFEST).unlink()
        case "empty manifest":
            (folder / MANIFEST).write_bytes(b"")
        case "manifest of another":
            store.put(OTHER, FILES)
            (folder / MANIFEST).write_bytes((store.path(OTHER) / MANIFEST).read_bytes())
    assert store.state(KEY) == "damaged"
    store.put(KEY, FILES)
    assert store.state(KEY) == "ok"


def test_stored_warnings_are_printed_as_before(store):
    sentence = "{source}: {rows} rows are late, by at most {delay:.3f} s"
    warning = notice("late_rows", sentence, Path("a.csv"), np.int64(3), np.float64(0.25))
    store.put(KEY, FILES | {METRICS: json.dumps({"warnings": [vars(warning)]}).encode()})
    assert store.row(KEY)["warnings"] == str(warning) == "a.csv: 3 rows are late, by at most 0.250 s"


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[]", b"[" * 5000, b"\xff", b'{"a": {"b": 1}}', b'{"warnings": [1]}', b'{"a": 1e999}'),
        b'{"a": 9' + b"9" * 5000 + b"}",
    ],
)
@pytest.mark.parametrize("name", [METRICS, FAILURE, MANIFEST])
def test_contents_of_other_types_are_damage(store, name, content):
    """In files whose checksums are right."""
    store.put(KEY, FILES | {name: content})
    if name == MANIFEST:
        (store.path(KEY) / name).write_bytes(content)
    assert store.state(KEY) == "damaged"
    with pytest.raises(DamagedError) as told:
        store.row(KEY)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 400
    store.put(KEY, FILES)
    assert store.state(KEY) == "ok"


def test_a_manifest_names_files_of_its_folder_alone(store):
    store.put(KEY, FILES)
    manifest = store.path(KEY) / MANIFEST
    manifest.write_text(manifest.read_text().replace("estimates.parquet", "../estimates.parquet"))
    assert store.state(KEY) == "damaged"


def test_a_pipe_in_the_place_of_a_file_is_damage_and_nobody_waits_for_it(store):
    store.put(KEY, FILES)
    (store.path(KEY) / METRICS).unlink()
    os.mkfifo(store.path(KEY) / METRICS)
    assert store.state(KEY) == "damaged"
    with pytest.raises(DamagedError, match="is a named pipe, expected a regular file"):
        store.read(KEY, METRICS)


def hold(folder, connection):
    """In another process: claim KEY and tell, until told to die."""
    with Store(folder).claim(KEY) as mine:
        connection.send(mine)
        connection.recv()


def test_a_claim_ends_with_its_owner_however_that_ends(store):
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    other = context.Process(target=hold, args=(store.folder.parent, there))
    other.start()
    assert here.recv() is True
    with store.claim(KEY) as mine:
        assert not mine
    with store.claim(OTHER) as mine:
        assert mine
    other.kill()
    other.join()
    with store.claim(KEY) as mine:
        assert mine
    assert list((store.folder / "claims").iterdir()) == []


def test_of_many_that_claim_at_once_one_gets_it(store):
    # each process claims and lets go in turn; a claim by two at once would leave a mark that the other has not removed
    script = (
        "import sys; from pathlib import Path; from factorgraph_loc.experiments.store import Store\n"
        "store, mark, got = Store(Path(sys.argv[1])), Path(sys.argv[1]) / 'mark', 0\n"
        "while got < 300:\n"
        "    with store.claim('ab') as mine:\n"
        "        if mine: mark.touch(exist_ok=False); mark.unlink(); got += 1\n"
    )
    command = [sys.executable, "-c", script, str(store.folder.parent)]
    others = [subprocess.Popen(command) for _ in range(3)]
    assert [other.wait(60) for other in others] == [0, 0, 0]


def test_what_a_dead_process_left_half_written_is_removed_and_what_a_living_one_writes_is_not(store):
    for key in (KEY, OTHER):
        (store.folder / "tmp" / key / "run").mkdir(parents=True)
    with store.claim(OTHER) as mine:
        assert mine
        store.create()
        assert [path.name for path in (store.folder / "tmp").iterdir()] == [OTHER]
    assert store.state(KEY) == "missing"


def test_a_write_that_fails_leaves_what_was_there(store, monkeypatch):
    store.put(KEY, FILES)

    def full(_handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match="No space left on device"):
        store.put(KEY, FILES | {METRICS: b"{}"})
    monkeypatch.undo()
    assert store.read(KEY, METRICS) == FILES[METRICS]
    assert list((store.folder / "tmp").iterdir()) == []


@pytest.mark.parametrize("folder", ["a file", "/proc"])  # neither of which root can write into
def test_a_folder_that_cannot_be_written_is_told_in_one_line(tmp_path, folder):
    path = Path("/proc/nowhere")
    if folder == "a file":
        (tmp_path / "file").write_text("")
        path = tmp_path / "file" / "out"
    with pytest.raises(StoreError, match="cannot be written"):
        Store(path).create()
