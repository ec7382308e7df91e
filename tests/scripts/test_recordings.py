"""Recordings of other people: the list, the commands that fetch them, and how small files of each kind become logs."""

import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from recordings_benchmark import by_hand, loops
from recordings_benchmark.listed import RECORDINGS, File, Recording, commands
from recordings_benchmark.prepare import KINDS, prepare
from recordings_benchmark.recordings import Job, measured

from factorgraph_loc.errors import InputError

LIBRSF = """\
odom2 0 0 0 0 0.0025 0.0025 0.0001
odom2 1 1.0 0.1 0.5 0.0025 0.0025 0.0001
range2 0 2.0 0.25 2.0 0.0 7 0
range2 1 -3.0 0.25 2.0 0.0 7 0
loop 0 1 0.5
point2 0 0 0 0 0 0 0
angle 0 0 0
point2 1 1 0.1 0 0 0 0
angle 1 0.5 0
"""
DIFFERENTIAL = "odom2diff 0 0.6 0.4 0 0.5 1 1 1\nodom2diff 1 0.6 0.4 0 0.5 1 1 1\npoint2 0 0 0 0 0 0 0\n"
TUM = "# of a camera that looks along x\n0 0 0 1 -0.5 0.5 -0.5 0.5\n1 1 0 1 -0.5 0.5 -0.5 0.5\n2 2 0 1 -0.5 0.5 -0.5 0.5\n"


def recording(kind, *names, **options):
    files = tuple(File("someone/something", "0" * 40, f"data/{name}", name) for name in names)
    return Recording("one", "One", "none", "wheels", "", kind, files, options=options)


def test_what_is_typed_by_hand_for_each_recording(tmp_path):
    jobs = by_hand.jobs_of(tmp_path, tmp_path)
    assert [job.recording.name for job in jobs] == [one.name for one in RECORDINGS]
    for job in jobs:
        for name, text in job.files.items():
            assert "{" not in re.sub(r"= \{ [^{}]* \}", "", text), name
            tomllib.loads(text)
        assert all("{" not in command and "--prior= " not in command for command in job.commands)
    by_name = {job.recording.name: job for job in jobs}
    assert sorted(by_name["m3500-skewed"].files) == ["anchors.world.toml", "run.toml"]
    assert "--prior=-4.83,0.36,-3.12 " in by_name["corridor"].commands[0]


def test_commands_are_typed_and_what_they_reach_is_told(tmp_path):
    for name in ("a.tum", "b.tum"):
        (tmp_path / name).write_text(TUM)
    commands = ("fgloc score b.tum a.tum -o out",)
    job = by_hand.Job(
        recording("trajectory", "a.tum", "b.tum"), tmp_path, tmp_path / "made", {"x.toml": "a = 1"}, commands
    )
    done = by_hand.measured(job)
    assert done.result == "0.000 after sim3"
    assert 0.0 < done.seconds < 60.0
    with pytest.raises(RuntimeError, match=r"fgloc info nothing: error: nothing: is neither"):
        by_hand.measured(replace(job, commands=("fgloc info nothing",)))


def test_every_recording_names_files_at_a_commit_and_how_they_are_read():
    assert len(RECORDINGS) >= 20
    names = [one.name for one in RECORDINGS]
    assert len(set(names)) == len(names)
    for one in RECORDINGS:
        assert one.kind in {"bag", *KINDS}
        assert one.licence
        assert all(re.fullmatch("[0-9a-f]{40}", file.commit) for file in one.files)
    (first, *_) = commands(RECORDINGS)
    assert first == (
        "curl -L -o husky-test1.bag https://raw.githubusercontent.com/cra-ros-pkg/robot_localization/"
        "c662a2f82a5ac7e557996fb4dbf78abf7e6b2ae1/test/test1.bag"
    )


def test_lines_of_librsf_are_motions_ranges_and_a_reference(tmp_path):
    (tmp_path / "in.txt").write_text(LIBRSF)
    log = prepare(recording("librsf", "in.txt"), tmp_path, tmp_path / "logs")
    odometry, seen = log.streams["odometry"], log.streams["bearing_range"]
    np.testing.assert_allclose((odometry.dx[1], odometry.dy[1], odometry.dtheta[1]), (1.0, 0.1, 0.5))
    assert list(seen.range) == [2.0]  # that below 0 is left out, with a warning
    assert log.world.landmarks["7"].x == 2.0
    np.testing.assert_allclose(log.reference.poses, ((0.0, 0.0, 0.0), (1.0, 0.1, 0.5)), atol=1e-6)
    assert (tmp_path / "logs" / "one" / "run.toml").is_file()


def test_speeds_of_two_wheels(tmp_path):
    (tmp_path / "in.txt").write_text(DIFFERENTIAL)
    log = prepare(recording("librsf", "in.txt"), tmp_path, tmp_path / "logs")
    np.testing.assert_allclose((log.streams["odometry"].v[0], log.streams["odometry"].w[0]), (0.5, -0.2))
    assert not log.reference.has_heading


def test_a_trajectory_has_simulated_odometry_or_that_of_another_program(tmp_path):
    (tmp_path / "truth.txt").write_text(TUM)
    simulated = prepare(recording("trajectory", "truth.txt", format="tum", axis="z"), tmp_path, tmp_path / "a")
    np.testing.assert_allclose(simulated.reference.poses[:, 2], 0.0, atol=1e-9)
    assert len(simulated.streams["odometry"].t) == 21
    other = recording("trajectory", "truth.txt", "truth.txt", format="tum", axis="z")
    log = prepare(other, tmp_path, tmp_path / "b")
    np.testing.assert_allclose(log.streams["odometry"].dx, (0.0, 1.0, 1.0), atol=1e-9)


def test_a_file_that_is_missing_is_said_in_a_line_for_every_estimator(tmp_path):
    one = recording("librsf", "in.txt")
    with pytest.raises(InputError, match=r"in.txt: is missing, scripts/bench_recordings --fetch"):
        prepare(one, tmp_path, tmp_path)
    found = measured(Job(one, tmp_path, tmp_path))
    assert set(found.scores.values()) == {"in.txt: is missing, scripts/bench_recordings --fetch prints how to fetch it"}


def test_loops_of_a_drive_and_which_of_them_are_right(tmp_path, monkeypatch):
    lines = [f"odom2 {i} {float(i > 0)} 0 0 0.0025 0.0025 0.0001" for i in range(9)]
    lines += [f"point2 {i} {i} 0 0 0 0 0" for i in range(9)] + ["loop 8 0 0.5", "loop 4.5 4 0.9"]
    (tmp_path / "in.txt").write_text("\n".join(lines))
    monkeypatch.setattr(loops, "RECORDINGS", (recording("librsf", "in.txt"),))
    log, near = loops.log_of("one", tmp_path, tmp_path / "logs")
    assert near.tolist() == [False, True]
    for keep in (near, ~near):
        assert loops.aligned_error(loops.Job(loops.chosen(log, keep), "smoother")) < 0.1
