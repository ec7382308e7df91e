"""Batch estimation in space: all poses at once, from measured motion and points of a known map.

One ``gtsam.Pose3`` per stamp; between-factors of the measured motion (``twist``), or of a random walk without it; and for each
image the points that the monoSLAM filter matched, with Huber loss. That filter runs along and provides initial values; its causal
estimates are not the batch's and are never ``localized``. Points that the map lacks are not used.

Point factors are linearised here, as in :mod:`~factorgraph_loc.fusion.problem`, and GTSAM solves.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.fusion.least_squares import damped_step, optimum
from factorgraph_loc.fusion.marginals import IndeterminateError, covariances, damped
from factorgraph_loc.model.belief import PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.sensors.twist.measurement import in_space, twist_settings
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factorgraph_loc.slam.monoslam import Monoslam, MonoslamSettings
from factorgraph_loc.slam.monoslam_sighting import Match
from factorgraph_loc.slam.monoslam_state import Eye, squared
from factorgraph_loc.slam.space_motion import RobotState, TwistChain
from factors import positive
from factors.robust import huber_loss, huber_weight
from factors.se2 import Array

RANDOM_WALK = (1.0, 1.0, 1.0)  # m and rad per sqrt(s), without measured motion


class SpaceBatchSettings(MonoslamSettings):
    """Settings of the filter that provides initial values; ``landmarks`` must be ``known``, and ``planar`` off."""


@dataclass(frozen=True)
class _SeenPoints:
    """The image of a camera at ``t``: ``pixels`` (K, 2) of ``points`` (K, 3) with covariances ``spreads`` (K, 3, 3);
    ``tempering``: exponent of the likelihood.
    """

    t: float
    eye: Eye
    pixels: Array
    points: Array
    spreads: Array | None
    tempering: float

    def linearize(self, pose: gtsam.Pose3) -> tuple[Array, Array]:
        """Whitened, robustly weighted residual (2K,) and Jacobian (2K, 6) with respect to the pose."""
        error, whitener, jacobian = self._whitened(pose)
        weight = np.sqrt(self.tempering * huber_weight(np.sum(error**2, axis=1), self.eye.model.robust))
        return (weight[:, None] * error).ravel(), (weight[:, None, None] * (whitener @ jacobian)).reshape(-1, 6)

    def cost(self, pose: gtsam.Pose3) -> float:
        """The robust loss, tempered."""
        sights = self.eye.known(_robot(pose), self.points, self.spreads)
        losses = huber_loss(squared(sights.pixels - self.pixels, sights.noise), self.eye.model.robust)
        return self.tempering * float(np.sum(losses))

    def _whitened(self, pose: gtsam.Pose3) -> tuple[Array, Array, Array]:
        sights = self.eye.known(_robot(pose), self.points, self.spreads)
        whitener = positive.whitener(sights.noise)
        return np.einsum("kij,kj->ki", whitener, sights.pixels - self.pixels), whitener, sights.by_pose


class SpaceBatch(Monoslam):
    """Robust optimum over the whole log in space, for a camera that is carried by hand. See the module."""

    estimates_points = False
    starts_in_space = True
    causal = False

    def __init__(self, setup: Setup, settings: SpaceBatchSettings) -> None:
        if settings.landmarks != "known" or settings.planar:
            raise InputError(
                "space_batch: works with points of a known map and a robot in space, expected planar = false"
            )
        super().__init__(setup, settings.model_copy(update={"planar": False}))
        twist = twist_settings(setup)
        self._chain = TwistChain(twist or TwistSettings(shift=RANDOM_WALK, turn=RANDOM_WALK))
        self._images: dict[tuple[float, bool], _SeenPoints] = {}
        self._prior: PosePrior | None = None
        self._conclusion: tuple[Trajectory3, Diagnostics] | None = None  # the result, until the next measurement

    def initialize(self, prior: PosePrior) -> None:
        """Start from a pose in space. Raises InputError for a planar pose."""
        if prior.space is None:
            raise InputError(
                "space_batch: the start is a pose on a floor, expected one in space: a log with such a reference"
            )
        self._prior = prior
        super().initialize(prior)

    def process(self, measurement: Measurement) -> None:
        """Process one measurement, in order or late by at most ``max_delay``."""
        self._conclusion = None
        twist = in_space(measurement)
        if twist is not None:
            self._chain.add(twist.t, twist.v, twist.w)
        super().process(measurement)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The filter's estimate, which is not to be scored: the problem is solved at the end only."""
        return replace(super().estimate(t), status="unlocalized")

    def space_trajectory(self) -> Trajectory3:
        """The optimum over the whole log, at the ticks."""
        return self._concluded()[0]

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics, including those of the final trajectory."""
        return self._concluded()[1]

    def _concluded(self) -> tuple[Trajectory3, Diagnostics]:
        """The final trajectory, and the diagnostics including it."""
        if self._conclusion is None:
            diagnostics = self.diagnostics.copy()
            self._conclusion = self._solution(diagnostics), diagnostics
        return self._conclusion

    def _solution(self, diagnostics: Diagnostics) -> Trajectory3:
        past = {record.t: record.robot for record in self._past()}
        t = np.array(sorted(past))
        values = gtsam.Values()
        for i, stamp in enumerate(t.tolist()):
            values.insert(i, _pose(past[stamp]))
        images = [(int(np.searchsorted(t, image.t)), image) for image in self._images.values()]
        motion = self._motion_graph(t)
        values, linear = _solved(motion, images, values)
        ticks = np.unique(np.array(self._ticks))
        rows = np.searchsorted(t, ticks).tolist()
        spreads = _covariances(linear, rows, t, diagnostics)
        poses = [values.atPose3(i) for i in rows]
        return Trajectory3(
            ticks,
            np.array([pose.translation() for pose in poses]).reshape(-1, 3),
            np.array([pose.rotation().matrix() for pose in poses]).reshape(-1, 3, 3),
            np.array([spreads[i] + self._mounting for i in rows]).reshape(-1, 6, 6),
        )

    def _matched(self, m: Pixels, match: Match, eye: Eye) -> None:
        if len(match.pixels):
            key = (m.t, m.right)
            self._images[key] = _SeenPoints(m.t, eye, match.pixels, match.points, match.spreads, match.tempering)

    def _motion_graph(self, t: Array) -> gtsam.NonlinearFactorGraph:
        assert self._prior is not None
        assert self._prior.space is not None
        start = self._prior.space
        graph = gtsam.NonlinearFactorGraph()
        first = self._chain.between(self._prior.t, float(t[0])) if t[0] > self._prior.t else None
        origin = gtsam.Pose3(gtsam.Rot3(start.rotation), start.position)
        spread = start.covariance
        if first is not None:
            step = gtsam.Pose3(gtsam.Rot3(first.rotation), first.shift)
            adjoint = step.inverse().AdjointMap()
            origin, spread = origin.compose(step), adjoint @ spread @ adjoint.T + first.covariance
        graph.add(gtsam.PriorFactorPose3(0, origin, gtsam.noiseModel.Gaussian.Covariance(spread)))
        for i in range(len(t) - 1):
            moved = self._chain.between(float(t[i]), float(t[i + 1]))
            noise = gtsam.noiseModel.Gaussian.Covariance(moved.covariance)
            step = gtsam.Pose3(gtsam.Rot3(moved.rotation), moved.shift)
            graph.add(gtsam.BetweenFactorPose3(i, i + 1, step, noise))
        return graph


def _covariances(
    linear: gtsam.GaussianFactorGraph, rows: list[int], t: Array, diagnostics: Diagnostics
) -> dict[int, Array]:
    """Covariances (6, 6) of the poses ``rows``. Raises RunFailedError if they are not determined."""
    try:
        found = covariances(linear, dict.fromkeys(range(len(t)), 6), rows)
    except IndeterminateError as error:
        what = "all poses" if error.key is None else f"the pose at {t[error.key]:.3f} s"
        raise RunFailedError(f"space_batch: the measurements do not determine {what}") from error
    if found.damping:
        diagnostics.events.append((float(t[-1]), damped(found.damping)))
    return found.by_key


def _solved(
    motion: gtsam.NonlinearFactorGraph, images: list[tuple[int, _SeenPoints]], values: gtsam.Values
) -> tuple[gtsam.Values, gtsam.GaussianFactorGraph]:
    """The optimum, and the problem linearised there."""
    units = {2 * len(image.pixels): gtsam.noiseModel.Unit.Create(2 * len(image.pixels)) for _, image in images}
    sizes = dict.fromkeys(range(values.size()), 6)

    def cost(at: gtsam.Values) -> float:
        return float(motion.error(at)) + sum(image.cost(at.atPose3(key)) for key, image in images)

    def linearized(at: gtsam.Values) -> gtsam.GaussianFactorGraph:
        graph = motion.linearize(at)
        for key, image in images:
            residual, jacobian = image.linearize(at.atPose3(key))
            graph.add(gtsam.JacobianFactor(key, jacobian, -residual, units[len(residual)]))
        return graph

    def moved(at: gtsam.Values, damping: float) -> gtsam.Values | None:
        step = damped_step(linearized(at), sizes, damping)
        return None if step is None else at.retract(step)

    found, _, _ = optimum(cost, moved, values)
    return found, linearized(found)


def _robot(pose: gtsam.Pose3) -> RobotState:
    return RobotState(np.asarray(pose.translation()), np.asarray(pose.rotation().matrix()), np.zeros(3), np.zeros(3))


def _pose(robot: RobotState) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(robot.rotation), robot.position)
