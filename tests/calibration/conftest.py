"""A robot whose constants are known: it reports what its wheels and its sensor, wrong in a known way, make of a true path. And
cameras that look at known points."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_loc.mapping.triangulation import Cameras, Tracks
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.map import Landmark
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factorgraph_loc.sensors.odometry.stream import IncrementStream, VelocityStream
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.vision.frame import CameraFrame
from factors import se2
from factors.camera.model import CameraModel, project
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import LogisticModel

STEP = 0.05  # s
WORLD = World(
    landmarks={
        f"{i}": Landmark(x=x, y=y)
        for i, (x, y) in enumerate([(-3.0, -3.0), (3.0, -3.0), (4.0, 4.0), (-4.0, 3.0), (0.0, 6.0), (6.0, 0.0)])
    }
)
UNKNOWING = Rig(name="unknown", bearing_range=BearingRangeSettings(range_sigma=0.2))


@dataclass(frozen=True)
class Robot:
    """The truth; noise of the path per sqrt(m) or sqrt(rad), scatter of sightings in m and rad."""

    scale_distance: float = 1.0
    scale_rotation: float = 1.0
    speed_bias: float = 0.0
    direction: float = 0.0
    delay: float = 0.0
    along: float = 0.01
    heading: float = 0.01
    x: float = 0.0
    y: float = 0.0
    bearing_bias: float = 0.0
    range_scale: float = 1.0
    depth: bool = False
    time_offset: float = 0.0
    range_sigma: float = 0.03
    bearing_sigma: float = 0.01
    outliers: float = 0.0


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Log]:
    """``simulate(seed=1, seconds=300.0, scale_distance=0.95, ...)``: a log with a rig that knows nothing of the robot."""

    def make(seed=1, seconds=300.0, **truth) -> Log:
        robot = Robot(**truth)
        rng = np.random.default_rng(seed)
        t = np.arange(round(seconds / STEP)) * STEP
        # speeds change often, and the robot stands for a third of each minute
        pieces = rng.uniform((0.1, -0.7), (0.6, 0.7), (len(t) // 40 + 1, 2))
        v, w = np.repeat(pieces, 40, axis=0)[: len(t)].T * (t % 60.0 < 40.0)
        late = round(robot.delay / STEP)
        moved_v, moved_w = (np.concatenate((np.zeros(late), u))[: len(t)] for u in (v, w))
        noise = rng.standard_normal((len(t), 3)) * np.sqrt(
            np.column_stack((robot.along**2 * moved_v, 0.0 * t, robot.heading**2 * np.abs(moved_w))) * STEP
        )
        twists = (
            np.column_stack((moved_v * np.cos(robot.direction), moved_v * np.sin(robot.direction), moved_w)) * STEP
            + noise
        )
        poses = np.zeros((len(t), 3))
        for i in range(1, len(t)):
            poses[i] = se2.compose(poses[i - 1], se2.exp(twists[i - 1]))
        truth = Trajectory(t, poses)
        odometry = VelocityStream(t, v / robot.scale_distance + robot.speed_bias, w / robot.scale_rotation)
        streams = {"odometry": odometry, "bearing_range": _sightings(truth, robot, rng)}
        return Log(f"simulated-{seed}", UNKNOWING, WORLD, streams, truth)

    return make


def _sightings(truth: Trajectory, robot: Robot, rng: np.random.Generator) -> BearingRangeStream:
    t = np.arange(1.0, truth.t[-1] - 1.0, 0.25)
    sensors = se2.compose(truth.at(t), np.array((robot.x, robot.y, 0.0)))
    names = np.tile(list(WORLD.landmarks), len(t))
    local = se2.transform_to(sensors[:, None], WORLD.positions()[None]).reshape(-1, 2)
    count = len(local)
    ranges = robot.range_scale * (local[:, 0] if robot.depth else np.hypot(*local.T))
    ranges += robot.range_sigma * rng.standard_normal(count)
    bearings = np.arctan2(local[:, 1], local[:, 0]) + robot.bearing_bias
    bearings += robot.bearing_sigma * rng.standard_normal(count)
    bad = rng.random(count) < robot.outliers
    ranges[bad] = rng.uniform(0.3, 15.0, np.sum(bad))
    bearings[bad] = rng.uniform(-np.pi, np.pi, np.sum(bad))
    stamps = np.repeat(t, len(WORLD.landmarks)) - robot.time_offset
    seen = local[:, 0] > 0.5 * np.abs(local[:, 1]) if robot.depth else np.ones(count, dtype=bool)
    return BearingRangeStream(stamps[seen], names[seen].tolist(), ranges[seen], se2.wrap(bearings[seen]))


@pytest.fixture
def headless() -> Callable[[Log], Log]:
    """The log with a reference whose headings mean nothing, and ranges alone."""

    def make(log: Log) -> Log:
        seen = log.streams["bearing_range"]
        streams = {**log.streams, "bearing_range": replace(seen, bearing=np.full_like(seen.bearing, np.nan))}
        return replace(log, streams=streams, reference=replace(log.reference, has_heading=False))

    return make


ANTENNAS = {
    "left": AntennaSettings(y=0.2, z=1.0, yaw=np.pi / 2),
    "right": AntennaSettings(y=-0.2, z=1.0, yaw=-np.pi / 2),
}
IN_PLACE = SurveySettings()
DETECTION = LogisticModel((4.0, -1.6, 0.08, -1.7, 0.26, -0.06, -0.6, -0.1, 1.9, 0.23, -0.15))


@pytest.fixture(scope="session")
def read_tags() -> Callable[..., Log]:
    """``read_tags(seed=1, seconds=200.0, model=..., survey=..., misplaced=2, facing=True)``: a log of independent reads.

    A robot drives circles among 30 tags with an antenna on each side, each with two inventory rounds a second. The rig knows the
    antennas' places alone; the map is as surveyed: it lies at ``survey`` in the world, and ``misplaced`` tags are 1 m off.
    """

    def make(seed=1, seconds=200.0, model=DETECTION, survey=IN_PLACE, misplaced=0, facing=True, height=0.0) -> Log:
        rng = np.random.default_rng(seed)
        t = np.arange(round(seconds / 0.1)) * 0.1
        speed, turn = 0.5, 0.25 * np.sin(0.11 * t) + 0.25
        poses = np.zeros((len(t), 3))
        for i in range(1, len(t)):
            poses[i] = se2.compose(poses[i - 1], se2.exp(np.array((speed, 0.0, turn[i])) * 0.1))
        middle, spread = np.mean(poses[:, :2], axis=0), np.ptp(poses[:, :2], axis=0) / 2.0 + 1.5
        places = np.column_stack(
            (middle + rng.uniform(-spread, spread, (30, 2)), 1.0 + height * rng.uniform(-1, 1, 30))
        )
        faced = rng.uniform(-np.pi, np.pi, 30) if facing else np.full(30, np.nan)
        rounds = np.arange(0.25, t[-1], 0.25)
        truth = Trajectory(t, poses)
        names = list(ANTENNAS)
        settings = RfidSettings(antennas=ANTENNAS, false_read=0.02, miss=0.02).model()
        likelihood = RfidLikelihood(replace(settings, models=(model,)), TagArray(places, faced))
        rows = []
        for k, (stamp, pose) in enumerate(zip(rounds, truth.at(rounds), strict=True)):
            read = np.flatnonzero(rng.random(30) < likelihood.probabilities(pose[None], k % 2)[0])
            rows += [(stamp, k, names[k % 2], f"tag{i}") for i in read] or [(stamp, k, names[k % 2], "")]
        nothing = np.full(len(rows), np.nan)
        stream = RfidStream(
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            [row[2] for row in rows],
            [row[3] for row in rows],
            np.zeros(len(rows)),
            *(nothing,) * 3,
        )
        surveyed = se2.transform_to(survey.transform(), places[:, :2])
        angle = rng.uniform(-np.pi, np.pi, misplaced)
        surveyed[:misplaced] += np.column_stack((np.cos(angle), np.sin(angle)))
        tags = {
            f"tag{i}": Tag(x=x, y=y, z=places[i, 2], facing=faced[i] - survey.heading if facing else None)
            for i, (x, y) in enumerate(surveyed.tolist())
        }
        motion = se2.between(poses[:-1], poses[1:]) + rng.normal(0.0, (0.002, 0.001, 0.003), (len(t) - 1, 3))
        odometry = IncrementStream(t, *np.vstack((np.zeros(3), motion)).T)
        rig = Rig(name="reader", sensors=("odometry", "rfid"), rfid=RfidSettings(antennas=ANTENNAS))
        return Log(f"reads-{seed}", rig, World(tags=tags), {"odometry": odometry, "rfid": stream}, truth)

    return make


@dataclass(frozen=True)
class Sight:
    """Points (P, 3) with descriptors, cameras that look at them, and what each of them sees, its features shuffled: ``shown`` tells
    which point each feature shows."""

    model: CameraModel
    points: np.ndarray
    cameras: Cameras
    frames: list[CameraFrame]
    shown: list[np.ndarray]

    def tracks(self) -> Tracks:
        """The true tracks of what is seen twice or more, with their points' numbers."""
        frame = np.repeat(np.arange(len(self.frames)), [len(s) for s in self.shown])
        point = np.concatenate(self.shown)
        pixels = np.concatenate([f.pixels for f in self.frames])
        feature = np.concatenate([np.arange(len(s)) for s in self.shown])
        every = Tracks(point, frame, feature, pixels)
        return every.kept(np.bincount(point)[point] >= 2)

    def moved(self, rng: np.random.Generator, turn: float, shift: float) -> Cameras:
        """The cameras as someone believes who is wrong by that much in each axis [rad, m]."""
        turns = Rotation.from_rotvec(turn * rng.standard_normal((len(self.cameras), 3))).as_matrix()
        shifts = shift * rng.standard_normal((len(self.cameras), 3, 1))
        return Cameras(
            self.cameras.positions + (self.cameras.rotations @ shifts)[..., 0], self.cameras.rotations @ turns
        )


@pytest.fixture
def look() -> Callable[..., Sight]:
    """``look(rng, ...)``: cameras on an arc that look at a cloud of points 2 m to 4 m away."""

    def make(
        rng: np.random.Generator, *, count: int = 12, points: int = 150, noise: float = 1.0, arc: float = 0.6
    ) -> Sight:
        model = CameraModel(
            525.0, 520.0, 320.0, 240.0, 640, 480, distortion=(0.05, -0.02, 0.001, 0.0), sigma=max(noise, 0.1)
        )
        cloud = rng.uniform((-1.2, -0.8, 2.0), (1.2, 0.8, 4.0), (points, 3))
        looks = rng.standard_normal((points, 16)).astype(np.float32)
        angles = np.linspace(-arc, arc, count)
        rotations = Rotation.from_rotvec(-angles[:, None] * np.array((0.0, 1.0, 0.0))).as_matrix()
        positions = np.array((0.0, 0.0, 3.0)) - 3.0 * rotations[:, :, 2]
        positions[:, 1] += 0.15 * arc * rng.uniform(-1.0, 1.0, count)
        cameras = Cameras(positions, rotations)
        frames, shown = [], []
        for i in range(count):
            local = (cloud - positions[i]) @ rotations[i]
            pixels = project(model, local) + noise * rng.standard_normal((points, 2))
            seen = rng.permutation(np.flatnonzero(model.contains(pixels) & (local[:, 2] > 0.1)))
            descriptors = looks[seen] + 0.1 * rng.standard_normal((len(seen), 16)).astype(np.float32)
            numbers = np.arange(len(seen))
            frames.append(CameraFrame(0.1 * i, "sift", pixels[seen], np.full(len(seen), 4.0), descriptors, numbers))
            shown.append(seen)
        return Sight(model, cloud, cameras, frames, shown)

    return make
