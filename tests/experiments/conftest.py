"""A short log, and an estimator that notes what it is given."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from in_short import blank_pictures, runs_here  # noqa: F401 - fixtures
from straight_log import log  # noqa: F401 - a fixture

from factorgraph_loc.experiments import run
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.belief import Learnt, PoseEstimate
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.plugins import ESTIMATORS


class FakeSettings(FileModel):
    """``localized_at`` [s]; ``broken_at`` [s]: from then on the pose is not a number."""

    localized_at: float = 0.0
    broken_at: float = 1e9


class Fake:
    """Stays at the prior and writes down all calls."""

    deterministic = True
    supports_unknown_start = False

    def __init__(self, setup, settings):
        self.diagnostics = Diagnostics()
        self.setup, self.settings = setup, settings
        self.calls, self.ticks = [], []
        self.pose, self.t = np.zeros(3), 0.0
        Fake.made = self

    def initialize(self, prior):
        self.calls.append(("initialize", prior.t))
        self.pose = prior.pose
        self.prior = prior

    def process(self, measurement):
        self.calls.append((type(measurement).__name__, measurement.t))
        self.t = measurement.t
        if self.calls[-1][0] == "Tick":
            self.ticks.append(measurement.t)

    def estimate(self, t=None):
        at = self.t if t is None else t
        self.calls.append(("estimate", at))
        pose = self.pose if at < self.settings.broken_at else np.full(3, np.nan)
        status = "localized" if at >= self.settings.localized_at else "unlocalized"
        return PoseEstimate(at, pose, np.eye(3), status)

    def learnt(self):
        return Learnt({"scale": (1.0, 0.1)})

    def trajectory(self):
        return Trajectory(np.array(self.ticks), np.tile(self.pose, (len(self.ticks), 1)))


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    """The class of the estimator that is registered as ``fake`` and not rehearsed; ``fake.made`` is the last one made."""
    monkeypatch.setitem(
        sys.modules, "factorgraph_loc.fusion.fake", SimpleNamespace(Fake=Fake, FakeSettings=FakeSettings)
    )
    monkeypatch.setitem(ESTIMATORS.own, "fake", "factorgraph_loc.fusion.fake:Fake")
    rehearse = run._rehearse
    monkeypatch.setattr(run, "_rehearse", lambda config, *rest: config.estimator == "fake" or rehearse(config, *rest))
    return Fake
