"""Whole logs: the same seed, the same log; what they state; what their odometry and sightings are like."""

import dataclasses

import numpy as np
import pytest

from factorgraph_loc import Landmark, World, write_rig
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.sensors.landmarks.measurement import SightingSettings
from factorgraph_loc.sensors.landmarks.simulation import sighting_stream
from factorgraph_loc.simulation import PRESETS, read_settings, simulate
from factors import se2
from factors.landmarks import model as bearing_range

SEEDS = range(20)


def columns(log):
    """All numbers and names of a log."""
    streams = {k: dataclasses.asdict(v) for k, v in log.streams.items()}
    return [log.world, log.rig, log.reference.poses.tobytes(), log.start.pose.tobytes(), repr(streams)]


@pytest.mark.parametrize("name", PRESETS)
def test_the_same_seed_gives_the_same_log_and_another_one_another(make, name):
    first = columns(make(3, name))
    assert first == columns(make(3, name))
    other = columns(make(4, name))
    assert all(a != b for a, b in zip(first[2:], other[2:], strict=True))


def test_a_fault_changes_nothing_else(make):
    plain, faulty = make(), make(faults={"dead": 0.5}, world={"landmarks": 5})
    assert plain.reference.poses.tobytes() == faulty.reference.poses.tobytes()
    assert plain.streams["odometry"].dx.tobytes() == faulty.streams["odometry"].dx.tobytes()
    assert plain.world.tags == faulty.world.tags


def test_the_stated_start_is_off_by_what_it_states(make):
    """3 x 20 squared errors in sigmas are chi-square with 60 degrees of freedom: inside 26 to 112 but in 1 of 10,000 tests."""
    total = 0.0
    for seed in SEEDS:
        log = make(seed, drive={"duration": 1.0})
        prior, source = resolve_prior(log, None)
        assert source == "log"
        error = prior.pose - log.reference.poses[0]
        error[2] = se2.wrap_scalar(error[2])
        total += float(error @ np.linalg.solve(prior.covariance, error))
    assert 26.4 < total < 112.4


def test_odometry_errs_as_the_rig_says(make):
    """Scales, drift and noise by least squares per run. In sigmas of the rig their squares are chi-square (of 20 runs: 3.4 to 58
    but in 1 of 10,000); the noise's variance is right to five standard errors."""
    constants, walks = [], []
    for seed in SEEDS:
        log = make(seed)
        odometry, truth = log.streams["odometry"], log.reference
        true = se2.between(truth.poses[:-1], truth.poses[1:])
        ds = np.hypot(true[:, 0], true[:, 1])
        moving = ds > 1e-4
        root = np.sqrt(ds[moving])
        along = (odometry.dx[1:] - true[:, 0])[moving] / root
        scale = (along @ (true[moving, 0] / root)) / ((true[moving, 0] / root) ** 2).sum()
        turn = se2.wrap(odometry.dtheta[1:] - true[:, 2])[moving] / root
        design = np.column_stack((true[moving, 2], ds[moving])) / root[:, None]
        (turn_scale, drift), *_ = np.linalg.lstsq(design, turn, rcond=None)
        spread = np.linalg.inv(design.T @ design) * 0.02618**2
        along_spread = 0.01**2 / ((true[moving, 0] / root) ** 2).sum()
        constants.append(
            (
                scale / np.sqrt(0.02**2 + along_spread),
                turn_scale / np.sqrt(0.02**2 + spread[0, 0]),
                drift / np.sqrt(0.01745**2 + spread[1, 1]),
            )
        )
        walks.append((along - scale * true[moving, 0] / root) / 0.01)
        walks.append((turn - design @ (turn_scale, drift)) / 0.02618)
    squares = (np.array(constants) ** 2).sum(axis=0)
    assert ((squares > 3.4) & (squares < 58.0)).all(), squares
    pooled = np.concatenate(walks)
    assert abs((pooled**2).mean() - 1.0) < 5.0 * np.sqrt(2.0 / len(pooled)) + 0.01  # 3 constants of 500 rows are fitted


def test_landmarks_in_sight_are_seen_with_the_noise_of_the_rig(make):
    log = make(world={"landmarks": 30}, drive={"duration": 300.0})
    assert log.rig.sensors == ("odometry", "rfid", "bearing_range")
    seen = log.streams["bearing_range"]
    points = np.array([log.world.position(name) for name in seen.landmark])
    model = log.rig.bearing_range.model()
    ranges, bearings = bearing_range.predict(model, log.reference.at(seen.t), points)
    sigma = bearing_range.sigmas(model, ranges)
    errors = np.column_stack((seen.range - ranges, se2.wrap(seen.bearing - bearings))) / sigma
    assert len(errors) > 500
    assert ranges.max() <= 6.0
    # five standard errors of mean and variance
    assert (np.abs(errors.mean(axis=0)) < 5.0 / np.sqrt(len(errors))).all()
    assert (np.abs(errors.var(axis=0) - 1.0) < 5.0 * np.sqrt(2.0 / len(errors))).all()


def test_no_landmark_is_seen_through_a_wall_too_far_or_out_of_view():
    places = {"behind": (3.0, 0.0), "beside": (3.0, 2.0), "far": (0.0, 9.0), "before": (0.9, 0.0), "back": (-1.0, 0.0)}
    world = World(
        landmarks={name: Landmark(x=x, y=y) for name, (x, y) in places.items()}, walls=((1.0, -1.0, 1.0, 0.5),)
    )
    settings = SightingSettings(max_range=8.0, field_of_view=3.2)
    look = (np.array((1.0,)), np.zeros((1, 3)), settings, np.random.default_rng(0))
    seen = sighting_stream(bearing_range.BearingRangeModel(), world, *look)
    assert seen.landmark == ["beside", "before"]


def test_a_file_changes_a_preset(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'preset = "sparse"\n[world]\ndensity = 0.1\n[rig.rfid]\ntempering = 0.5\n[rig.rfid.antennas.left]\nyaw = 1.57\n'
    )
    settings = read_settings(path, {"drive": {"duration": 5.0}})
    assert settings.name == "mine"
    assert settings.world.tag_count() == 24
    assert settings.drive.duration == 5.0
    assert settings.rig.rfid.tempering == 0.5
    assert list(settings.rig.rfid.all_antennas()) == ["left"]
    assert simulate(settings, 0).name == "mine-0"


def test_a_file_may_name_a_rig(tmp_path, make):
    write_rig(make(rig={"name": "other"}).rig, tmp_path / "other.rig.toml")
    path = tmp_path / "mine.toml"
    path.write_text('rig = "other.rig.toml"\n')
    settings = read_settings(path, {"rig": {"rfid": {"tempering": 0.3}}})
    assert (settings.rig.name, settings.rig.rfid.tempering) == ("other", 0.3)
