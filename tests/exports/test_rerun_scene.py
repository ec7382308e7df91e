"""Recordings of Rerun are read back with its own reader."""

import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.exports.runs import find_runs, read_runs
from factorgraph_loc.maps.points import PointMap
from factors.camera import model as reprojection

rr = pytest.importorskip("rerun")
from rerun.chunk import RrdReader  # noqa: E402
from rerun.error_utils import RerunWarning  # noqa: E402

from factorgraph_loc.exports import rerun_scene  # noqa: E402

POINTS = np.array(((2.0, 0.0, 0.5), (2.0, 0.2, 0.6), (-5.0, 0.0, 0.5)))


class Recording:
    """What a file holds: rows by entity and component, as (seconds or None, value)."""

    def __init__(self, path):
        self.rows = {}
        for chunk in RrdReader(path).stream():
            table = chunk.to_record_batch().to_pydict()
            times = table.pop(rerun_scene.TIMELINE, None)
            for column, values in table.items():
                name = column.rpartition(":")[2]
                found = self.rows.setdefault((chunk.entity_path, name), [])
                found += [(None if times is None else times[i].total_seconds(), v) for i, v in enumerate(values)]

    def __call__(self, entity, component):
        return self.rows.get((entity, component), [])


@pytest.fixture(scope="module")
def recording(log, results, tmp_path_factory):
    none = np.empty(0, dtype=np.int64)
    points = PointMap(
        ("p", "q", "behind"),
        POINTS,
        np.tile(1e-4 * np.eye(3), (3, 1, 1)),
        "",
        none,
        np.empty((0, 0)),
        np.empty((0, 3)),
    )
    world = log.world.model_copy(update={"points": points})
    path = tmp_path_factory.mktemp("rerun") / "arc.rrd"
    with warnings.catch_warnings():
        warnings.simplefilter("error", RerunWarning)  # it tells of wrong values by warnings only
        rerun_scene.write_rrd(replace(log, world=world), read_runs(find_runs(results), log), path)
    return Recording(path)


def test_the_file_is_whole(log, results, tmp_path):
    """What the library cannot write it only logs."""
    path = tmp_path / "arc.rrd"
    rerun_scene.write_rrd(log, read_runs(find_runs(results), log), path)
    program = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True, check=False
    )
    assert program.returncode == 0, program.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["arc.rrd"]


def test_robots_go_their_ways(log, results, recording):
    for run in read_runs(find_runs(results), log):
        rows = recording(f"/world/{run.name}/robot", "translation")
        assert np.allclose([t for t, _ in rows], run.causal.t)
        assert np.allclose(
            [np.ravel(value) for _, value in rows], np.pad(run.causal.poses[:, :2], ((0, 0), (0, 1))), atol=1e-6
        )
        x, y, z, w = np.array([np.ravel(v) for _, v in recording(f"/world/{run.name}/robot", "quaternion")]).T
        assert np.allclose((x, y), 0.0)
        assert np.allclose(2.0 * np.arctan2(z, w), run.causal.poses[:, 2], atol=1e-6)
        assert len(recording(f"/world/{run.name}/ellipse", "strips")) == len(run.causal)
        ((_, (path,)),) = recording(f"/world/{run.name}/final", "strips")
        assert np.allclose(np.array(path)[:, :2], run.final.poses[:, :2], atol=1e-6)


def test_tags_are_lit_while_they_are_read(recording):
    rows = recording("/world/tags/lit", "labels")
    assert [(t, v) for t, v in rows if t is not None] == [
        (1.0, ["A"]),
        (1.5, []),
        (1.8, ["A"]),
        (2.0, ["A", "B"]),
        (2.3, ["B"]),
        (2.5, []),
    ]
    places = dict(recording("/world/tags/lit", "positions"))
    assert np.allclose(places[2.3], [(1.5, 1.0, 0.4)])


def test_errors_and_events(log, results, recording):
    ekf = next(run for run in read_runs(find_runs(results), log) if run.name == "ekf")
    t, errors = ekf.series["error_position"]
    rows = recording("/plots/error_position/ekf", "scalars")
    assert np.allclose([at for at, _ in rows], t)
    assert np.allclose([v for _, (v,) in rows], errors)
    assert recording("/events/ekf", "text") == [(1.25, ["a jump"])]


def test_pictures_with_what_is_seen_and_what_should_be(log, results, recording):
    run = read_runs(find_runs(results), log)[0]
    camera = f"/world/{run.name}/robot/camera"
    assert [t for t, _ in recording(f"{camera}/image", "blob")] == [0.5, 1.5, 2.5]
    seen = [(t, v) for t, v in recording(f"{camera}/image/landmarks", "positions") if t is not None]
    assert seen == [(0.5, [[1.5, 4.5], [2.5, 5.5]]), (1.5, [[3.5, 6.5]])]
    expected = dict(recording(f"{camera}/image/map", "positions"))
    (pose,) = run.causal.at(np.array((1.5,)))
    pixels, _ = reprojection.predict(log.rig.camera.model(), pose, POINTS[:2])
    order = np.argsort(pixels[:, 0])
    found = np.array(expected[1.5])
    assert np.allclose(found[np.argsort(found[:, 0])], pixels[order] + 0.5, atol=1e-4)
