"""The factor graph of a camera in space: all its poses, from its motion and points of a known map.

One ``gtsam.Pose3`` per stamp; its motion as measured (``twist``), with a velocity that changes at random
(:mod:`.space_motion_models`), or with one that an inertial unit tells (:mod:`.inertial_motion`); and for each image the points that
the monoSLAM filter matched, with Huber loss. That filter runs along and provides initial values. Points that the map lacks are not
used.

Point factors are linearised here, as in :mod:`~factorgraph_loc.fusion.problem`, and GTSAM solves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.fusion.least_squares import damped_step, optimum
from factorgraph_loc.fusion.marginals import IndeterminateError, covariances, damped
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.slam.inertial_motion import STRIDE, measured_motion
from factorgraph_loc.slam.monoslam import MonoslamSettings
from factorgraph_loc.slam.monoslam_past import UpdateRecord
from factorgraph_loc.slam.monoslam_sighting import Match
from factorgraph_loc.slam.monoslam_state import Eye, Sights, SlamState, each_squared
from factorgraph_loc.slam.space_motion_models import AT_ONCE, ConstantVelocity, KnownState, robot_of
from factors import positive
from factors.camera.depth import with_inverse
from factors.robust import huber_loss, huber_weight
from factors.se2 import Array


class SpaceGraphSettings(MonoslamSettings):
    """Settings of the filter that provides initial values; ``landmarks`` must be ``known``, and ``planar`` off."""


def of_space(name: str, settings: SpaceGraphSettings) -> SpaceGraphSettings:
    """The settings of an estimator for a robot in space; InputError for others."""
    if settings.landmarks != "known" or settings.planar:
        raise InputError(f"{name}: works with points of a known map and a robot in space, expected planar = false")
    return settings.model_copy(update={"planar": False})


def start_in_space(name: str, prior: PosePrior) -> PosePrior:
    """The start of an estimator for a robot in space; InputError for one on a floor."""
    if prior.space is None:
        raise InputError(
            f"{name}: the start is a pose on a floor, expected one in space: a log with such a reference, or unknown"
        )
    return prior


def known_start(t: float, state: SlamState) -> KnownState:
    """What is known when a filter begins."""
    return KnownState(t, state.robot, state.covariance[: state.base, : state.base], state.constants)


@dataclass(frozen=True)
class SeenPoints:
    """The image of a camera at ``t``: ``pixels`` (K, 2) of ``points`` (K, 3) with covariances ``spreads`` (K, 3, 3);
    ``tempering``: exponent of the likelihood; ``depths`` (K,) [m], NaN where none was measured, or None.
    """

    t: float
    eye: Eye
    pixels: Array
    points: Array
    spreads: Array | None
    tempering: float
    depths: Array | None = None

    @property
    def size(self) -> int:
        """The number of values of the residual: two of each pixel, with depths three."""
        return self.pixels.size if self.depths is None else self.pixels.size + len(self.depths)

    def linearize(self, pose: gtsam.Pose3) -> tuple[Array, Array]:
        """Whitened, robustly weighted residual (``size``,) and Jacobian (``size``, 6) with respect to the pose."""
        sights, residual = self._seen(pose)
        whitener = positive.whitener(sights.noise)
        error = np.einsum("kij,kj->ki", whitener, residual)
        trust = huber_weight(each_squared(residual, sights.noise), self.eye.model.robust)
        weight = np.sqrt(self.tempering * trust)
        return (weight * error).ravel(), (weight[:, :, None] * (whitener @ sights.by_pose)).reshape(-1, 6)

    def cost(self, pose: gtsam.Pose3) -> float:
        """The robust loss, tempered."""
        sights, residual = self._seen(pose)
        squares = each_squared(residual, sights.noise)[:, 1:]  # of the pixel once, and perhaps of the depth
        return self.tempering * float(np.sum(huber_loss(squares, self.eye.model.robust)))

    def _seen(self, pose: gtsam.Pose3) -> tuple[Sights, Array]:
        """What is predicted, and the residual (K, 2 or 3), predicted minus measured."""
        sights = self.eye.known(robot_of(pose), self.points, self.spreads, self.depths)
        return sights, sights.pixels - with_inverse(self.pixels, self.depths)


class SpaceProblem:
    """The graph of the estimator ``name``, and its robust optimum over the whole log. ``first``: what is known of the start;
    ``motion``: how the robot moves; ``images``: what was seen, by time and whether with the right camera."""

    def __init__(self, name: str, setup: Setup, settings: MonoslamSettings) -> None:
        self._name = name
        self._chain, measured = measured_motion(setup)
        self.motion = measured or ConstantVelocity(settings.acceleration, settings.angular_acceleration)
        self.images: dict[tuple[float, bool], SeenPoints] = {}
        self.first: KnownState | None = None
        self._conclusion: tuple[Trajectory3, Diagnostics] | None = None  # the result, until the next measurement

    def take(self, measurement: Measurement) -> None:
        """Take in the motion, if a measurement tells it; what was concluded holds no more."""
        self._conclusion = None
        if self._chain is not None:
            self._chain.take(measurement)

    def see(self, m: Pixels, match: Match, eye: Eye) -> None:
        """Take in what was matched in an image."""
        key = (m.t, m.right)
        self.images.pop(key, None)  # it may have been matched before a late measurement
        if len(match.pixels):
            seen = match.pixels, match.points, match.spreads, match.tempering, match.depths
            self.images[key] = SeenPoints(m.t, eye, *seen)

    def later(self, known: KnownState, t: float) -> KnownState:
        """What is known at ``t``."""
        return known.moved(self.motion.step(known, t), t) if t > known.t else known

    def concluded(
        self,
        past: Callable[[], Sequence[UpdateRecord]],
        ticks: Sequence[float],
        mounting: Array,
        diagnostics: Diagnostics,
    ) -> tuple[Trajectory3, Diagnostics]:
        """The optimum at the ``ticks``, and the diagnostics with those of it. Raises RunFailedError if it is not determined.

        ``past`` gives the records of the filter, to begin with; ``mounting``: the covariance (6, 6) that is added, of the camera's
        place on the robot.
        """
        if self._conclusion is None:
            diagnostics = diagnostics.copy()
            self._conclusion = self._solution(past(), np.unique(np.array(ticks)), mounting, diagnostics), diagnostics
        return self._conclusion

    def _solution(
        self, records: Sequence[UpdateRecord], ticks: Array, mounting: Array, diagnostics: Diagnostics
    ) -> Trajectory3:
        past = {record.t: KnownState(record.t, record.robot, record.covariance, record.constants) for record in records}
        if not past:  # nothing told where an unknown start was
            return Trajectory3(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 6, 6)))
        t = np.array(sorted(past))
        t = t[np.append(True, np.diff(t) > AT_ONCE)]
        values = gtsam.Values()
        sizes: dict[int, int] = {}
        for i, stamp in enumerate(t.tolist()):
            values.insert(self.motion.values(i, past[stamp]))
            sizes |= self.motion.sizes(i)
        images = [(int(_at(t, image.t)), image) for image in self.images.values()]
        values, linear = _solved(self._motion_factors(t), images, values, sizes)
        rows = _at(t, ticks).tolist()
        spreads = self._covariances(linear, sizes, rows, t, diagnostics)
        poses = [values.atPose3(i) for i in rows]
        return Trajectory3(
            ticks,
            np.array([pose.translation() for pose in poses]).reshape(-1, 3),
            np.array([pose.rotation().matrix() for pose in poses]).reshape(-1, 3, 3),
            np.array([spreads[i] + mounting for i in rows]).reshape(-1, 6, 6),
        )

    def _motion_factors(self, t: Array) -> list[gtsam.NonlinearFactor]:
        """The factors of the start and of the motion between the stamps."""
        assert self.first is not None
        start = self.later(self.first, float(t[0]))
        times, factors = t.tolist(), [self.motion.prior(0, start)]
        for i in range(1, len(times)):
            part = slice(max(0, i - 2), i + 1)
            factors += self.motion.factors(range(len(times))[part], times[part], start)
        return factors

    def _covariances(
        self,
        linear: gtsam.GaussianFactorGraph,
        sizes: Mapping[int, int],
        rows: list[int],
        t: Array,
        diagnostics: Diagnostics,
    ) -> dict[int, Array]:
        """Covariances (6, 6) of the poses ``rows``. Raises RunFailedError if they are not determined."""
        try:
            found = covariances(linear, sizes, rows)
        except IndeterminateError as error:
            what = "all poses" if error.key is None else f"the pose at {t[error.key % STRIDE]:.3f} s"
            raise RunFailedError(f"{self._name}: the measurements do not determine {what}") from error
        if found.damping:
            diagnostics.events.append((float(t[-1]), damped(found.damping)))
        return found.by_key


def _at(t: Array, stamps: Array | float) -> NDArray[np.intp]:
    """The poses at ``stamps``, of poses at times ``t``."""
    return np.asarray(np.searchsorted(t, np.asarray(stamps) + AT_ONCE, side="right") - 1)


def _solved(
    motion: Sequence[gtsam.NonlinearFactor],
    images: list[tuple[int, SeenPoints]],
    values: gtsam.Values,
    sizes: Mapping[int, int],
) -> tuple[gtsam.Values, gtsam.GaussianFactorGraph]:
    """The optimum, and the problem linearised there."""
    units = {image.size: gtsam.noiseModel.Unit.Create(image.size) for _, image in images}

    def cost(at: gtsam.Values) -> float:
        moved = sum(factor.error(_only(factor, at)) for factor in motion)
        return moved + sum(image.cost(at.atPose3(key)) for key, image in images)

    def linearized(at: gtsam.Values) -> gtsam.GaussianFactorGraph:
        graph = gtsam.GaussianFactorGraph()
        for factor in motion:
            graph.push_back(factor.linearize(_only(factor, at)))
        for key, image in images:
            residual, jacobian = image.linearize(at.atPose3(key))
            graph.add(gtsam.JacobianFactor(key, jacobian, -residual, units[len(residual)]))
        return graph

    def moved(at: gtsam.Values, damping: float) -> gtsam.Values | None:
        step = damped_step(linearized(at), sizes, damping)
        return None if step is None else at.retract(step)

    found, _, _ = optimum(cost, moved, values)
    return found, linearized(found)


def _only(factor: gtsam.NonlinearFactor, at: gtsam.Values) -> gtsam.Values:
    """The poses of a factor of ours: GTSAM copies all that it is given for each call of one."""
    if not isinstance(factor, gtsam.CustomFactor):
        return at
    values = gtsam.Values()
    for key in factor.keys():  # noqa: SIM118
        values.insert(key, at.atPose3(key))
    return values
