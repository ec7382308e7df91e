"""The benchmarks of speed: references localize, least times are kept, and what became slower is told."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from speed_benchmark import peers, quick
from speed_benchmark.ours import CONFIGS, measured
from speed_benchmark.peers import PEERS, Peer
from speed_benchmark.problems import landmark_log, problem_of
from speed_benchmark.programs import gtsam_loops, numpy_filters, plain
from speed_benchmark.quick import Pair

from factorgraph_loc.errors import InputError


@pytest.fixture(scope="module")
def log():
    return landmark_log(25.0)


@pytest.fixture(scope="module")
def problem(log):
    return problem_of(log)


@pytest.mark.parametrize(
    "loop",
    [numpy_filters.ekf, numpy_filters.particles, gtsam_loops.lag, gtsam_loops.full, gtsam_loops.batch],
    ids=lambda loop: loop.__name__,
)
def test_references_localize(problem, loop):
    found = plain.measured(problem, loop)
    assert found["position"] < 0.15
    assert found["heading"] < 0.15
    assert 0.0 < found["seconds"] < 60.0


@pytest.mark.parametrize("label", ["EKF", "batch"])
def test_ours_solve_the_same_problem(log, problem, label):
    assert set(log.streams) == {"odometry", "bearing_range"}  # nothing that the references do not have
    found = measured(log, problem, CONFIGS[label])
    assert found["position"] < 0.15
    assert found["seconds"] > 0.0
    assert ("median" in found) == (label == "EKF")


def test_a_problem_is_read_as_it_was_written_and_can_be_cut(problem, tmp_path):
    problem.save(tmp_path / "problem.npz")
    read = plain.read_problem(tmp_path / "problem.npz")
    assert read.start == problem.start
    assert np.array_equal(read.sightings, problem.sightings)
    part = read.until(10.0)
    assert [kind for kind, *_ in part.events()] == [k for k, t, _ in read.events() if t <= read.start + 10.0]


def test_motion_comes_to_the_reference(problem):
    """Composed from plain numbers alone, noise apart: a metre at most after 25 s."""
    motion, pose = plain.Motion(problem.growth), tuple(problem.pose)
    for kind, _, what in problem.events():
        if kind == plain.MOTION:
            motion.add(*what)
    x, y, h, covariance = motion.take()
    end = plain.composed(pose, (x, y, h))
    assert np.hypot(*(np.array(end[:2]) - problem.reference[-1, :2])) < 1.5
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert motion.so_far() == (0.0, 0.0, 0.0)


def works(*seconds):
    """A workload that takes these times, one after the other."""
    times = iter(seconds)
    return lambda: next(times)


def test_the_least_time_of_both_counts_and_the_first_round_does_not():
    pair = Pair(works(0.1, 4.0, 3.0, 5.0), works(0.1, 2.0, 1.5, 1.0), "steady")
    assert quick.measure({"one": pair}) == {"one": (3.0, 1.0)}


@pytest.mark.parametrize(("ours", "code"), [(2.4, 0), (2.6, 1)])
def test_a_quarter_more_than_before_is_a_loss(tmp_path, monkeypatch, capsys, ours, code):
    def pairs(seconds):
        return lambda: {"EKF": Pair(lambda: seconds, lambda: 1.0, "numpy EKF")}

    monkeypatch.setattr(quick, "workloads", pairs(2.0))
    assert quick.quick(tmp_path / "new/before.json", None) == 0
    monkeypatch.setattr(quick, "workloads", pairs(ours))
    capsys.readouterr()
    assert quick.quick(tmp_path / "now.json", tmp_path / "new/before.json") == code
    told = capsys.readouterr().out
    assert f"| EKF | {ours:.3f} | numpy EKF | 1.000 | {ours:.2f} | 2.00 |" in told
    assert ("slower than before: EKF: 2.60, was 2.00" in told) == bool(code)
    assert quick.read_ratios(tmp_path / "now.json") == {"EKF": ours}


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"ratios": {"EKF": "fast"}}', '{"ratios": 3}'])
def test_what_is_no_table_of_ratios_is_refused(tmp_path, content):
    (tmp_path / "before.json").write_text(content)
    with pytest.raises(InputError, match=r"expected a table that scripts/bench --quick has stored"):
        quick.quick(tmp_path / "now.json", tmp_path / "before.json")


def test_all_workloads_are_there():
    assert {*CONFIGS} < {*quick.workloads()}
    assert {peer.ours for peer in PEERS} == {*CONFIGS}
    folder = Path(plain.__file__).parent
    assert all((folder / f"{peer.program}.py").is_file() for peer in PEERS)


def saying(seconds):
    found = {"seconds": seconds, "median": 100.0, "p99": 200.0, "position": 0.06, "heading": 0.07}
    return (sys.executable, "-c", f"print({json.dumps(json.dumps(found))})")


def test_programs_are_called_and_the_table_has_the_ratios():
    found = peers.measure([saying(2.0), saying(3.0)], 1)
    lines = peers.table([Peer("EKF", "another", "p", "l")], {"EKF": found[0]}, found[1:])
    assert lines[2] == "| EKF | 2.00 | 0.10 / 0.20 | 0.060 | another | 3.00 | 0.10 / 0.20 | 0.060 | 1.50 |"


def test_what_is_missing_is_told(monkeypatch):
    lacking = {"no_such_package": "No module named 'no_such_package'"}
    assert peers.missing(sys.executable, ["json", "no_such_package"]) == lacking
    with pytest.raises(InputError, match="--peers: nowhere is no Python that can be called"):
        peers.missing("nowhere", ["numpy"])
    with pytest.raises(InputError, match="ValueError: no filter"):
        peers.measure([(sys.executable, "-c", "raise ValueError('no filter')")], 1)
    monkeypatch.setattr(peers, "describe", lambda _: [])
    with pytest.raises(InputError, match="mrclam6-robot3 is not in the folder of recorded data"):
        peers.compare_peers(sys.executable, None, 1)
