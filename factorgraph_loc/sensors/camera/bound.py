"""The camera sensor of a run: points of the map, by name or matched by appearance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self, cast

import numpy as np

from factorgraph_loc.model.variable import NOTHING, Estimated
from factorgraph_loc.sensors.base import Binding, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.camera.finder import MISSED, PixelFinder
from factorgraph_loc.sensors.camera.sensor import (
    CAMERAS,
    ITERATIONS,
    SETTLED,
    KnownPoints,
    Pixels,
    Predicted,
    pixel_update,
)
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import TIME_OFFSET
from factors.se2 import Array
from factors.update import Correction

SOLVE_EVERY = 0.45  # s between solver updates; in between, images only update the newest pose, as in a filter


@dataclass(frozen=True)
class PixelObservation(ResidualObservation):
    """Points seen in one image. ``expected`` (3,): the predicted pose used to match them. ``held``: the camera's constants (P,)
    with their covariance (P, P), if the observation depends on the pose only."""

    iterations: ClassVar[int] = ITERATIONS
    settled: ClassVar[float] = SETTLED
    expected: Array = field(default_factory=lambda: np.zeros(3))
    held: tuple[Array, Array] | None = None

    @property
    def factor(self) -> ReprojectionFactor:
        """One factor for all points."""
        return cast(ReprojectionFactor, self.terms[0].factor)

    def correct(
        self,
        pose: Array,
        covariance: Array,
        values: Mapping[str, Array],
        columns: Mapping[str, slice],
        iterations: int = ITERATIONS,
    ) -> Correction:
        if self.held is not None:
            found = pixel_update(self.factor, pose, covariance, *self.held)
            return replace(found, delta=found.delta[:3], covariance=found.covariance[:3, :3])
        if self.factor.of_pose_alone and len(covariance) == 3:
            return pixel_update(self.factor, pose, covariance)
        return super().correct(pose, covariance, values, columns, iterations)

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        factor, spreads = self.factor, None
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
        """The observation on the pose only; the uncertainty of the camera's constants is added to the noise."""
        if not self.blocks:
            return self
        (name,) = self.blocks
        terms = (replace(self.terms[0], blocks=()),)
        return replace(self, terms=terms, held=(values[name], spreads[name]))


class CameraSensor(Sensor):
    """A camera that sees points of the map. ``points``: matching and outlier rejection."""

    modality = "camera"
    lost = MISSED
    follows_constants = True  # matching depends on them

    def __init__(self, binding: Binding, constants: Estimated) -> None:
        setup, motion, diagnostics, use = binding.setup, binding.motion, binding.diagnostics, binding.points
        self._uncertain, self._motion = constants, motion
        self.constants = constants if binding.calibration == "all" else NOTHING
        self.points = KnownPoints(setup, diagnostics, constants, use, motion)
        self._shared = (self.modality,) if constants.names else ()
        if self.points.known:
            self.finder = PixelFinder(self.points, motion)
            # pixels of known points determine the pose so well that the graph need not be solved for each image, unless the
            # camera's
            # mounting is estimated
            self.solve_every = 0.0 if constants.names else SOLVE_EVERY

    def observe(self, m: Pixels, view: View) -> Iterator[PixelObservation]:
        twist = self._motion.twist(m.t) if self.points.needs_twist else None
        predicted, values, spreads = Predicted(view.pose, view.covariance), {}, {}
        for name in self._shared:
            value = view.value(name)
            values[name] = np.zeros(len(self._uncertain.names)) if value is None else value
            spreads[name] = np.diag(self._uncertain.sigmas**2) if value is None else view.spread(name)
            predicted = replace(predicted, constants=values[name], spread=spreads[name])
        factor = self.points.factor(m, predicted, view.offset, twist)
        if factor is None:
            return
        seen = PixelObservation(m.t, (Term(factor, self._shared, 2 * len(factor.points)),), view.pose)
        yield seen if self.constants.names else seen.on_pose(values, spreads)

    def judge(self, observation: PixelObservation, correction: Correction, view: View) -> bool:
        self.points.report(observation.t, observation.factor, correction)
        return True


def bind(binding: Binding) -> CameraSensor | None:
    """The sensor of a run, or None if it is not used. With particles, its constants are not estimated but widen the noise."""
    setup = binding.setup
    if setup.rig.find(CameraSettings) is None or not any(sensor in setup.sensors for sensor in CAMERAS):
        return None
    return CameraSensor(binding, NOTHING if binding.calibration == "none" else setup.rig.estimated("camera"))
