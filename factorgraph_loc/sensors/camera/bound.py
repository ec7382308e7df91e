"""The camera sensor of a run: points of the map, by name or matched by appearance."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.base import Binding, NewVariable, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.camera.finder import MISSED, PixelFinder
from factorgraph_loc.sensors.camera.sensor import (
    CAMERAS,
    ITERATIONS,
    SETTLED,
    KnownPoints,
    Pixels,
    Predicted,
    pixel_update,
    rows_of,
)
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors import se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import TIME_OFFSET
from factors.se2 import Array
from factors.update import Correction, update_state

PASS = 10.0  # s: looks within it have the error of a point's survey in common, where that is not estimated
SOLVE_EVERY = 0.45  # s between solver updates; in between, images only update the newest pose, as in a filter


@dataclass(frozen=True)
class PixelObservation(ResidualObservation):
    """Points seen in one image: one term for those that are where the map has them, and one for each block of others.

    ``seen``: all as one factor on the pose and the camera's constants, where the map has them; ``names`` (K,): the blocks of their
    displacements, empty for those that have none. ``expected`` (3,): the predicted pose used to match them. ``held``: the camera's
    constants (P,) with their covariance (P, P), if the observation depends on the pose only.
    """

    iterations: ClassVar[int] = ITERATIONS
    settled: ClassVar[float] = SETTLED
    seen: ReprojectionFactor
    names: tuple[str, ...]
    expected: Array = field(default_factory=lambda: np.zeros(3))
    held: tuple[Array, Array] | None = None

    @classmethod
    def of(
        cls, t: float, seen: ReprojectionFactor, names: tuple[str, ...], shared: tuple[str, ...], expected: Array
    ) -> Self:
        """The observation of ``seen``, whose points have the blocks ``names`` (K,); ``shared``: that of the constants, if any."""
        if not any(names):
            return cls(t, (Term(seen, shared, 2 * len(names)),), seen, names, expected)
        terms = []
        for name in dict.fromkeys(names):
            part = rows_of(seen, np.array([one == name for one in names]))
            part = replace(part, in_image=len(names))
            if name:
                part = replace(part, point_covariances=None, free=True)
            terms.append(Term(part, (*shared, name) if name else shared, 2 * len(part.points)))
        return cls(t, tuple(terms), seen, names, expected)

    def correct(
        self,
        pose: Array,
        covariance: Array,
        values: Mapping[str, Array],
        columns: Mapping[str, slice],
        iterations: int = ITERATIONS,
    ) -> Correction:
        if self.held is not None:
            found = pixel_update(self.seen, pose, covariance, *self.held)
            return replace(found, delta=found.delta[:3], covariance=found.covariance[:3, :3])
        if self.seen.of_pose_alone and len(covariance) == 3:
            return pixel_update(self.seen, pose, covariance)
        if not any(self.names):
            return super().correct(pose, covariance, values, columns, iterations)
        free, size = self._as_free(), max((3, *(columns[name].stop for name in self.blocks)))
        shared = [name for name in self.blocks if name not in self.names]
        own = [(row, name) for row, name in enumerate(self.names) if name]

        def linearize(delta: Array) -> tuple[Array, Array]:
            at, displacement = se2.compose(pose, se2.exp(delta[:3])), np.zeros((len(self.names), 3))
            for row, name in own:
                displacement[row] = values[name] + delta[columns[name]]
            constants = [values[name] + delta[columns[name]] for name in shared]
            residual, (by_pose, *by_shared, by_point) = free.whitened([at, *constants, displacement])
            jacobian = np.zeros((*residual.shape, size))
            jacobian[..., :3] = by_pose @ se2.right_jacobian(delta[:3])
            for name, block in zip(shared, by_shared, strict=True):
                jacobian[..., columns[name]] = block
            for row, name in own:
                jacobian[row, :, columns[name]] = by_point[row]
            return residual, jacobian

        found = update_state(linearize, covariance, free.weight, iterations, free.dof(), self.settled)
        # pixels are so much better than the survey that it matters in which frame the covariance is: that of the updated pose
        reset = np.eye(len(covariance))
        reset[:3, :3] = se2.right_jacobian(found.delta[:3])
        return replace(found, covariance=reset @ found.covariance @ reset.T)

    def _as_free(self) -> ReprojectionFactor:
        """All points as free ones: the covariances of those that have a block are in the state."""
        spreads = self.seen.point_covariances
        if spreads is not None:
            spreads = np.where([[[not name]] for name in self.names], spreads, 0.0)
        return replace(self.seen, free=True, point_covariances=spreads)

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        factor, spreads = self.seen, None
        if factor.point_covariances is not None or self.held is not None:
            _, by_pose, by_point, by_constants = reprojection.linearize(factor.model, self.expected, factor.points)
            spreads = np.broadcast_to(factor.model.sigma**2 * np.eye(2), (len(by_point), 2, 2))
            if factor.point_covariances is not None:
                spreads = spreads + by_point @ factor.point_covariances @ by_point.transpose(0, 2, 1)
            if self.held is not None:
                if factor.twist is not None:
                    by_constants[..., TIME_OFFSET] = by_pose @ factor.twist
                by_constants = by_constants[..., list(factor.estimated)]
                # the error of the constants is common to all pixels, so it must not average out
                common = by_constants @ self.held[1] @ by_constants.transpose(0, 2, 1)
                spreads = spreads + len(common) * common
        return reprojection.log_likelihood(factor.model, poses, factor.points, factor.pixels, spreads)

    def on_pose(self, values: Mapping[str, Array], spreads: Mapping[str, Array]) -> Self:
        """The observation on the pose only; the uncertainty of the camera's constants and of points is added to the noise."""
        if not self.blocks:
            return self
        seen = self.seen
        if any(self.names):
            assert seen.point_covariances is not None
            points, noise = seen.points.copy(), seen.point_covariances.copy()
            for row, name in enumerate(self.names):
                if name:  # several points with one displacement tell no more of it than one
                    points[row] += values[name]
                    noise[row] = self.names.count(name) * spreads[name]
            seen = replace(seen, points=points, point_covariances=noise)
        shared = [name for name in self.blocks if name not in self.names]
        held = (values[shared[0]], spreads[shared[0]]) if shared else None
        terms = (Term(seen, (), 2 * len(seen.points)),)
        return replace(self, terms=terms, seen=seen, names=("",) * len(self.names), held=held)


class CameraSensor(Sensor):
    """A camera that sees points of the map. ``points``: matching and outlier rejection."""

    modality = "camera"
    lost = MISSED
    follows_constants = True  # matching depends on them

    def __init__(self, binding: Binding, constants: Estimated) -> None:
        setup, motion, diagnostics, use = binding.setup, binding.motion, binding.diagnostics, binding.points
        self._uncertain, self._motion = constants, motion
        self.constants = constants if binding.calibration == "all" else NOTHING
        self._carries = binding.calibration != "particles"  # too many for particles
        self.points = KnownPoints(setup, diagnostics, constants, use, motion)
        # times [s] of recent looks at what was surveyed with an error and is not estimated
        self._looks: dict[str, list[float]] = defaultdict(list)
        self._shared = (self.modality,) if constants.names else ()
        if self.points.known:
            self.finder = PixelFinder(self.points, motion)
            # pixels of known points determine the pose so well that the graph need not be solved for each image, unless the
            # camera's mounting is estimated
            self.solve_every = 0.0 if constants.names else SOLVE_EVERY

    def observe(self, m: Pixels, view: View) -> Iterator[PixelObservation | NewVariable]:
        twist = self._motion.twist(m.t) if self.points.needs_twist else None
        predicted, values, spreads = Predicted(view.pose, view.covariance), {}, {}
        for name in self._shared:
            value = view.value(name)
            values[name] = np.zeros(len(self._uncertain.names)) if value is None else value
            spreads[name] = np.diag(self._uncertain.sigmas**2) if value is None else view.spread(name)
            predicted = replace(predicted, constants=values[name], spread=spreads[name])
        displaced, blocks = {}, {}
        for name, (points, survey) in self.points.inexact(m).items():
            block = f"{self.modality}/{name}"
            if self._carries and view.value(block) is None:
                yield NewVariable(block, np.zeros(3), np.zeros((3, 3)), {}, survey, ())
            by, spread = view.value(block), survey
            if by is None:
                by, spread = np.zeros(3), self._looks_now(name, m.t) * survey
            else:
                spread = view.spread(block)
                blocks.update(dict.fromkeys(points, block))
            displaced.update(dict.fromkeys(points, (by, len(points) * spread)))
        factor = self.points.factor(m, predicted, view.offset, twist, displaced)
        if factor is None:
            return
        names = tuple(blocks.get(name, "") for name in self.points.names) or ("",) * len(factor.points)
        seen = PixelObservation.of(m.t, factor, names, self._shared, view.pose)
        yield seen if self.constants.names or any(names) else seen.on_pose(values, spreads)

    def _looks_now(self, name: str, t: float) -> int:
        """Add a look at a point or marker; how many there were within :data:`PASS`, with the error of its survey in common."""
        looks = [*(one for one in self._looks[name] if one > t - PASS), t]
        self._looks[name] = looks
        return len(looks)

    def rewind(self, t: float) -> None:
        for name, looks in self._looks.items():
            self._looks[name] = [one for one in looks if one <= t]

    def restart(self, t: float) -> None:
        self._looks.clear()

    def judge(self, observation: PixelObservation, correction: Correction, view: View) -> bool:
        self.points.report(observation.t, observation.seen, correction)
        return True


def bind(binding: Binding) -> CameraSensor | None:
    """The sensor of a run, or None if it is not used. With particles, its constants are not estimated but widen the noise."""
    setup = binding.setup
    if setup.rig.find(CameraSettings) is None or not any(sensor in setup.sensors for sensor in CAMERAS):
        return None
    return CameraSensor(binding, NOTHING if binding.calibration == "none" else setup.rig.estimated("camera"))
