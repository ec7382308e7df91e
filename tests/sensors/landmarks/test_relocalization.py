"""Where a robot is, from the last sightings alone, on a simulated run and on recorded ones."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc import BearingRange, Rig, World
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.landmarks.finder import LandmarkFinder, TrackMonitor
from factorgraph_loc.sensors.landmarks.known import KnownLandmarks
from factorgraph_loc.sensors.landmarks.sensor import bind
from factorgraph_loc.sensors.motion import Motion
from factors import se2


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=40.0)


class Seeker:
    """Feeds a relocalizer with the sightings of a log from ``start`` on."""

    def __init__(self, log, start=0.0):
        self.log, diagnostics = log, Diagnostics()
        self.motion = Motion(log.rig, log.rig.sensors, diagnostics)
        self.landmarks = KnownLandmarks(log.rig.bearing_range, log.world, diagnostics)
        self.relocalizer = LandmarkFinder(self.landmarks.factor, self.motion, log.world.positions())
        self.measurements = (m for m in log.measurements(log.rig.sensors) if m.t >= start - 3.0)
        self.start = start

    def sightings(self):
        """Odometry state, factor and time of each stamp, the odometry before it taken in."""
        for m in self.measurements:
            if not isinstance(m, BearingRange):
                self.motion.add(m)
            elif m.t >= self.start and (seen := self.landmarks.factor(m)) is not None:
                yield self.motion.state(m.t), seen, m.t

    def stamps(self, count):
        for odometry, seen, _ in itertools.islice(self.sightings(), count):
            self.relocalizer.add(odometry, seen)
        self.relocalizer.search()
        return self.relocalizer


def error(log, found):
    """Position [m] and heading [rad], and the normalised squared error."""
    difference = found.pose - log.reference.at(np.array([found.t]), max_gap=5.0)[0]
    difference[2] = se2.wrap_scalar(difference[2])
    squared = difference @ np.linalg.solve(found.covariance, difference)
    return np.hypot(*difference[:2]), abs(difference[2]), squared


def test_late_and_repeated_sightings_change_nothing(log):
    once, again = Seeker(log), Seeker(log)
    rows = list(itertools.islice(again.sightings(), 12))
    for i in [*range(0, 12, 2), *range(1, 12, 2), 11, 3]:
        again.relocalizer.add(*rows[i][:2])
    once.stamps(12)
    again.relocalizer.search()
    # which sightings stand for their neighbours depends a little on the order
    np.testing.assert_allclose(once.relocalizer.best.pose, again.relocalizer.best.pose, atol=0.1)
    assert once.relocalizer.best.t == again.relocalizer.best.t


def test_nothing_is_left_to_search(log):
    relocalizer = Seeker(log).stamps(12)
    assert relocalizer.best is not None
    relocalizer.forget(np.inf)
    relocalizer.search()
    assert (relocalizer.best, relocalizer.hypotheses) == (None, ())


def test_a_wrong_track_is_suspected_and_refuted_and_a_right_one_is_not(log):
    seeker, covariance = Seeker(log, 10.0), np.diag((0.05, 0.05, 0.02)) ** 2
    right, wrong = TrackMonitor(), TrackMonitor()
    for odometry, seen, t in itertools.islice(seeker.sightings(), 40):
        pose = log.reference.at(np.array([t]))[0]
        elsewhere = se2.compose(pose, np.array((1.5, 0.0, 1.0)))
        right.add(t, seen, pose, covariance)
        wrong.add(t, seen, elsewhere, covariance)
        seeker.relocalizer.add(odometry, seen)
    assert right.suspicious_since is None
    assert wrong.suspicious_since == pytest.approx(10.0, abs=0.5)
    seeker.relocalizer.search()
    assert seeker.relocalizer.refutes(elsewhere, covariance)
    assert not seeker.relocalizer.refutes(pose, covariance)


def test_a_track_that_others_confirm_is_no_longer_in_doubt():
    """Landmarks that the map has in wrong places do not begin the same search anew at each look."""
    world = World(landmarks={name: {"x": 3.0, "y": float(y)} for y, name in enumerate("abc")})
    rig = Rig(bearing_range={"range_sigma": 0.05})
    setup = Setup(rig, world, ("odometry", "bearing_range"), np.random.default_rng(0))
    diagnostics = Diagnostics()
    sensor = bind(Binding(setup, Motion(setup.rig, setup.sensors, diagnostics), diagnostics))
    view = SimpleNamespace(
        t=0.0,
        offset=None,
        newest=True,
        localized=True,
        pose=np.zeros(3),
        covariance=1e-4 * np.eye(3),
        value=lambda _: None,
    )
    for k in range(8):
        seen = BearingRange(0.5 * k, ("a", "b", "c"), np.full(3, 9.0), np.full(3, 1.0))
        (observation,) = sensor.observe(seen, view)
        sensor.finder.follow(observation, sensor.finder._motion.state(0.5 * k), view)
    assert sensor.suspicious_since is not None
    sensor.accept()
    assert sensor.suspicious_since is None
