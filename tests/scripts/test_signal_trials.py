"""Commands that are ended at random moments: a handful here, many by hand (scripts/try_signals)."""

from dataclasses import replace

import pytest
from signal_trials.trials import HALF, Bench, contents, drawn


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("bench") / "small", seconds=3)


@pytest.fixture(scope="module")
def convert(bench):
    (convert,) = [command for command in bench.commands() if command.name == "convert"]
    bench.measure(convert)
    return convert


def test_signals_to_a_conversion_leave_nothing(bench, convert):
    assert len(convert.expected) > 3
    assert convert.timed == set()
    for command, how, after in drawn([convert], 2, seed=3):
        assert bench.try_signal(command, how, after).faults == ()


def test_what_is_wrong_is_seen(bench, convert):
    other = dict.fromkeys(convert.expected, b"another") | {"more.csv": b""}
    (bench.folder / ".log.fgloc-01234567").mkdir()  # nothing writes there
    faults = bench.try_signal(replace(convert, expected=other), "KILL", 0.0).faults
    (bench.folder / ".log.fgloc-01234567").rmdir()
    assert "again: more.csv is missing" in faults
    assert "again: copy/run.toml differs" in faults
    assert "again: .log.fgloc-01234567 stays" in faults


def test_times_are_not_compared_and_half_a_file_is_told(tmp_path):
    (tmp_path / "metrics.json").write_text('{"timing.update": 3.0, "anees": 1.0}')
    (tmp_path / "half.json").write_text('{"anees": ')
    (tmp_path / "half.html").write_text("<html>")
    (tmp_path / ".hidden.json").write_text("{")
    assert contents(tmp_path) == {"metrics.json": b'{"anees": 1.0}', "half.json": HALF, "half.html": HALF}


def test_the_moments_are_those_of_the_seed(bench):
    commands = bench.commands()
    for command in commands:
        command.seconds = 2.0
    assert drawn(commands, 5, 1) == drawn(commands, 5, 1) != drawn(commands, 5, 2)
    assert len(drawn(commands, 20, 0)) == 100
