"""A robot that drives circles among tags, with reads as a known model of detection makes them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from by_hand import reads
from drives import driven

from factorgraph_loc import IncrementStream, Log, Rig, Tag, Trajectory, World
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import LogisticModel

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
        poses = driven(se2.exp(np.column_stack((np.full(len(t), speed), 0.0 * t, turn))[1:] * 0.1))
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
            rows += [(stamp, k, names[k % 2], name, 0.0) for name in [f"tag{i}" for i in read] or [""]]
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
        return Log(f"reads-{seed}", rig, World(tags=tags), {"odometry": odometry, "rfid": reads(*rows)}, truth)

    return make
