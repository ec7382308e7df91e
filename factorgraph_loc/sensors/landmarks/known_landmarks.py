"""Factors of identified landmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import BearingRangeModel, packed
from factors.landmarks.update_kernels import innovations
from factors.motion import Increment
from factors.se2 import Array
from factors.update import Correction


class KnownLandmarks:
    """Turns measurements into factors. Landmarks that map or rig lack are counted as ignored.

    ``use`` of the map: ``known`` uses its landmarks and ignores others, ``extended`` also estimates the others, ``unknown``
    estimates all landmarks without the map. ``estimated``: indices of the sensor's constants that are estimated. ``carries``:
    whether the estimator estimates landmarks with an inexact survey; otherwise the survey's covariance is added to the noise.
    """

    def __init__(
        self,
        setup: Setup,
        diagnostics: Diagnostics,
        use: MapUse = "known",
        estimated: tuple[int, ...] = (),
        *,
        carries: bool = False,
    ) -> None:
        settings = setup.rig.bearing_range if "bearing_range" in setup.sensors else None
        self._model = None if settings is None else settings.model()
        landmarks = {} if use == "unknown" else setup.world.landmarks
        self._positions = {name: np.array((m.x, m.y)) for name, m in landmarks.items()}
        limit = math.inf if settings is None else 2.0 * (settings.exact_survey * settings.range_sigma) ** 2
        spreads = {name: m.spread() for name, m in landmarks.items()}
        self._surveys = {name: spread for name, spread in spreads.items() if np.trace(spread) > limit}
        self._carries = carries
        self._maps_others = use != "known"
        self._estimated = estimated
        self._diagnostics = diagnostics

    @property
    def known(self) -> bool:
        """Whether there is a landmark sensor and the map has landmarks."""
        return self._model is not None and bool(self._positions)

    def factor(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> BearingRangeFactor | None:
        """The factor of the known landmarks, on the pose at the measurement's time or on one that lies ``offset`` before it.

        ``twist`` (3,): the robot's velocity at that time, needed if the sensor's time offset is estimated.
        """
        if self._model is None:
            self._diagnostics.ignore("bearing_range", len(m.landmarks))
            return None
        known = [i for i, name in enumerate(m.landmarks) if name in self._positions]
        told = _told(m)
        rows = [i for i in known if told[i]]
        if len(known) < len(m.landmarks) and not self._maps_others:
            self._diagnostics.ignore("landmark not in the map", len(m.landmarks) - len(known))
        if len(rows) < len(known):
            self._diagnostics.ignore("neither range nor bearing", len(known) - len(rows))
        if self._carries and self._surveys:
            rows = [i for i in rows if m.landmarks[i] not in self._surveys]
        if not rows:
            return None
        points = np.array([self._positions[m.landmarks[i]] for i in rows])
        factor = self._factor(self._model, m, rows, points, offset, twist)
        if self._surveys and any(m.landmarks[i] in self._surveys for i in rows):
            spreads = np.array([self._surveys.get(m.landmarks[i], np.zeros((2, 2))) for i in rows])
            factor = replace(factor, point_covariances=spreads)
        return factor

    def surveyed(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> list[tuple[str, BearingRangeFactor]]:
        """The landmarks with an inexact survey by name, each with a factor on the pose and its position."""
        if self._model is None or not self._carries or not self._surveys:
            return []
        told = _told(m)
        rows = [i for i, name in enumerate(m.landmarks) if name in self._surveys and told[i]]
        free = [self._factor(self._model, m, [i], np.zeros((1, 2)), offset, twist) for i in rows]
        return [(m.landmarks[i], replace(factor, free=True)) for i, factor in zip(rows, free, strict=True)]

    def survey(self, name: str) -> tuple[Array, Array]:
        """Position (2,) and covariance (2, 2) of a landmark in the map."""
        return self._positions[name], self._surveys[name]

    def others(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> list[tuple[str, BearingRangeFactor]]:
        """The landmarks to be estimated by name, each with a factor on the pose and its position (the last value)."""
        if self._model is None or not self._maps_others:
            return []
        found = []
        for i, name in enumerate(m.landmarks):
            if name in self._positions:
                continue
            if np.isnan(m.range[i]) or np.isnan(m.bearing[i]):
                self._diagnostics.ignore("unknown landmark without range and bearing")
            else:
                factor = self._factor(self._model, m, [i], np.zeros((1, 2)), offset, twist)
                found.append((name, replace(factor, free=True)))
        return found

    def _factor(
        self,
        model: BearingRangeModel,
        m: BearingRange,
        rows: list[int],
        points: Array,
        offset: Increment | None,
        twist: Array | None,
    ) -> BearingRangeFactor:
        everything = len(rows) == len(m.landmarks)
        return BearingRangeFactor(
            model,
            points,
            m.range if everything else m.range[rows],
            m.bearing if everything else m.bearing[rows],
            None if offset is None else offset.delta,
            None if offset is None else offset.covariance,
            estimated=self._estimated,
            twist=twist,
            in_look=None if offset is None else self._count(m),
        )

    def _count(self, m: BearingRange) -> int:
        """Number of usable landmarks: those of the map with either value, others with both."""
        lacks = zip(m.landmarks, np.isnan(m.range).tolist(), np.isnan(m.bearing).tolist(), strict=True)
        return sum(
            not (no_range and no_bearing)
            if name in self._positions
            else self._maps_others and not (no_range or no_bearing)
            for name, no_range, no_bearing in lacks
        )

    def report(self, t: float, factor: BearingRangeFactor, update: Correction) -> None:
        """Record the innovation of an update at time ``t``."""
        self._diagnostics.innovation("bearing_range", t, update.nis, update.dof)
        ranges, bearings = innovations(packed(factor.model), update.residual, factor.ranges, factor.bearings)
        self._diagnostics.add_residuals("bearing_range.range", ranges.tolist())
        self._diagnostics.add_residuals("bearing_range.bearing", bearings.tolist())


def _told(m: BearingRange) -> list[bool]:
    """Of each landmark whether its range or its bearing was measured."""
    return [r == r or b == b for r, b in zip(m.range.tolist(), m.bearing.tolist(), strict=True)]  # noqa: PLR0124 - not NaN


def together(factors: Sequence[BearingRangeFactor]) -> BearingRangeFactor:
    """Merge the factors of one measurement on one pose."""
    first, *others = factors
    if not others:
        return first
    covariances = [
        np.zeros((len(f.points), 2, 2)) if f.point_covariances is None else f.point_covariances for f in factors
    ]
    return replace(
        first,
        points=np.concatenate([f.points for f in factors]),
        ranges=np.concatenate([f.ranges for f in factors]),
        bearings=np.concatenate([f.bearings for f in factors]),
        point_covariances=np.concatenate(covariances),
    )
