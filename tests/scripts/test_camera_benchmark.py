"""Logs with faults, and the cells of tables, of the benchmark of the cameras."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from benchmarking.ensemble import RunErrors, Series
from camera_benchmark import faulty
from camera_benchmark.drives import SIGMAS, with_errors
from camera_benchmark.faults import cells, said
from camera_benchmark.faulty import Given
from camera_benchmark.frame import frame_known
from camera_benchmark.report import NOTHING, Attempt, accuracy_cells, paired, ratio_cell
from camera_benchmark.reprojection import reprojection_residuals, spread_of
from space_world import SIGMA, carried

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.simulation import preset, simulate
from factors.rfid.detection import RfidLikelihood

COUNT = 60


@pytest.fixture
def given(tmp_path):
    rng = np.random.default_rng(1)
    files = [tmp_path / f"{i:06d}.jpg" for i in range(COUNT)]
    for file in files:
        faulty.save(file, rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    camera = CameraSettings(width=64, height=48, fx=40.0, fy=40.0, cx=32.0, cy=24.0)
    t = np.arange(COUNT) * 2.0
    log = Log(
        name="room",
        rig=Rig(camera=camera),
        world=World(points=PointMap.of(("a", "b", "c"), np.array(((0.0, 0, 1), (0.1, 0, 1), (5, 5, 1))))),
        streams={"camera": ImageStream(t, files)},
        reference=Trajectory(t, np.zeros((COUNT, 3))),
    )
    return Given(log, rng, tmp_path / "fault")


def test_five_images_each_are_missing_truncated_and_of_another_size(given):
    files = faulty.damaged(given).streams["camera"].file

    changed = [new for new, old in zip(files, given.log.streams["camera"].file, strict=True) if new != old]
    missing = [file for file in changed if not file.exists()]
    images = [cv2.imread(str(file)) for file in changed if file not in missing]
    small = [image for image in images if image is not None and image.shape[:2] == (24, 32)]
    assert (len(changed), len(missing), len(small)) == (15, 5, 5)


def test_nothing_is_in_view_for_a_minute(given):
    stream = faulty.nothing_in_view(given).streams["camera"]

    grey = np.array([cv2.imread(str(file)).std() < 1.0 for file in stream.file])
    np.testing.assert_array_equal(grey, (stream.t >= 40.0) & (stream.t < 100.0))


def test_an_object_covers_a_third_of_every_image(given):
    changed, original = (log.streams["camera"].file for log in (faulty.object_in_the_way(given), given.log))

    places = set()
    for new, old in zip(changed, original, strict=True):
        difference = np.abs(cv2.imread(str(new)).astype(float) - cv2.imread(str(old)))
        columns = difference.mean(axis=(0, 2)) > 20.0  # compressed twice, other columns differ a little
        assert 19 <= np.count_nonzero(columns) <= 23
        places.add(int(np.argmax(columns)))
    assert len(places) > 3


def test_the_place_with_most_points_moves_by_a_metre(given):
    before, after = given.log.world.points.positions, faulty.moved_landmark(given).world.points.positions

    np.testing.assert_allclose(np.linalg.norm(after - before, axis=1), (1.0, 1.0, 0.0))


def test_images_out_of_order_keep_their_stamps(given):
    old, new = given.log.streams["camera"], faulty.out_of_order(given).streams["camera"]

    assert dict(zip(new.t, new.file, strict=True)) == dict(zip(old.t, old.file, strict=True))
    assert np.count_nonzero(np.diff(new.t) < 0.0) == COUNT // 5


def test_a_fault_may_be_estimated(given):
    camera = faulty.FAULTS["focal length 5 % too long, estimated"](given).rig.camera

    assert (camera.fx, camera.uncertainty.focal) == (pytest.approx(42.0), 0.05)


def test_a_reference_is_off_by_what_it_states(given):
    t = np.arange(4000) * 0.1
    log = replace(given.log, reference=Trajectory(t, np.zeros((4000, 3))))

    noisy = with_errors(log, 0).reference

    # a standard deviation of 4000 draws is right to 5 % but once in 1e5 times
    np.testing.assert_allclose(noisy.poses.std(axis=0), SIGMAS, rtol=0.05)
    np.testing.assert_allclose(noisy.covariances[7], np.diag(SIGMAS**2))


def run_with(error, nis=1.0, warnings=(), **figures):
    """A run that is off by ``error`` at all times."""
    t = np.arange(100) * 1.0
    one = Series(t, np.full(100, error), np.full(100, 0.01), np.full(100, 3.0))
    rmses = {f"{kind}.position_rmse": error for kind in ("causal", "final")}
    rmses |= {f"{kind}.heading_rmse": 0.01 for kind in ("causal", "final")}
    return Attempt(RunErrors(one, one, (), None), {**rmses, "nis.camera.mean_per_dof": nis, **figures}, warnings)


def test_what_is_said_is_what_the_fault_adds():
    right = run_with(0.01, warnings=("room: a tag is left out",))
    wrong = run_with(0.01, 4.0, ("room: a tag is left out", "room: images are grey"))

    assert said(wrong, right) == "images are grey; NIS 1 → 4"
    assert said(right, right) == NOTHING
    lost = replace(right, events=("lost since 3.5 s; goes on", "lost since 7.0 s; goes on"))
    assert said(lost, right) == "lost; goes on (2 times)"
    assert said(Attempt(None, {}, failure="room: no"), right) == "room: no"


def test_a_run_that_does_not_come_back_is_called_lost():
    right = [run_with(0.01)]
    assert cells([run_with(0.05)], right)[2] == "0.050"
    assert cells([run_with(0.05), run_with(0.3)], right)[2] == "0.300, lost"
    assert cells([run_with(0.05), run_with(0.3)], [run_with(0.2)])[2] == "0.300"
    assert cells([run_with(0.05), Attempt(None, {}, failure="no")], right)[0] == "1 of 2 refused"


def test_ratios_and_differences_are_of_the_logs_that_both_have():
    found = {seed: {"a": run_with(0.02), "b": run_with(0.01)} for seed in range(6)}
    found[6] = {"a": run_with(9.0), "b": Attempt(None, {}, failure="no")}

    assert ratio_cell(found, "a", "b", "final") == ("2.000 (2.000 to 2.000)", "2.000")
    row = next(row for row in paired(found, "a", "b") if row["metric"] == "final.position_rmse")
    assert (row["difference"], row["low"], row["high"], row["pairs"]) == pytest.approx((0.01, 0.01, 0.01, 6))


def test_cells_of_an_estimator_that_says_nothing_before_the_end():
    one = run_with(0.01)
    nothing = Series(one.errors.final.t, *(np.full(100, np.nan) for _ in range(3)))
    batch = replace(one.errors, causal=nothing)

    assert accuracy_cells([batch, batch]) == ("–", "–", "0.0100", "0.573", "0.0100", "– / 3.00", "– / 100 %")


def test_residuals_of_the_true_poses_are_the_noise_of_the_pixels():
    log = carried(2)
    assert spread_of(reprojection_residuals(log.reference3, log, "sightings_right"))["u_rms"] == pytest.approx(
        SIGMA, rel=0.1
    )


def test_the_bound_of_a_frame_is_that_of_the_probabilities_of_all_reads():
    log = simulate(preset("office", {"world": {"tags": 20}, "drive": {"duration": 30.0}}), 5)
    found = frame_known(log)

    likelihood = RfidLikelihood(log.rig.rfid.model(), tag_map(log.world, SurveySettings()).tags)
    poses = log.reference.at(np.unique(log.streams["rfid"].t))
    middle = np.mean(np.vstack((log.reference.poses[:1], poses)), axis=0)[:2]

    def probabilities(move):
        c, s = np.cos(move[2]), np.sin(move[2])
        places = middle + (poses[:, :2] - middle) @ np.array(((c, s), (-s, c))) + move[:2]
        moved = np.column_stack((places, poses[:, 2] + move[2]))
        return np.concatenate([likelihood.probabilities(moved, antenna).ravel() for antenna in range(8)])

    p = probabilities(np.zeros(3))
    slope = np.array([probabilities(step) - probabilities(-step) for step in 1e-4 * np.eye(3)]) / 2e-4
    x, y = log.reference.poses[0, :2] - middle
    of_start = np.linalg.inv(np.array(((1, 0, -y), (0, 1, x), (0, 0, 1))))
    told = (slope / (p * (1.0 - p))) @ slope.T
    told += np.linalg.inv(of_start @ np.diag(log.start.sigmas**2) @ of_start.T)
    spread, away = np.linalg.inv(told), np.mean(np.sum((poses[:, :2] - middle) ** 2, axis=1))

    assert found.least == pytest.approx(np.sqrt(spread[0, 0] + spread[1, 1] + spread[2, 2] * away), rel=0.02)
    off = (log.start.pose - log.reference.poses[0]) / log.start.sigmas
    assert found.nees == pytest.approx(off @ off)
