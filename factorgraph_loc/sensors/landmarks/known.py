"""Measurements of landmarks as factors, by what the map and the rig say about each landmark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import MapUse
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeSettings, points_of
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import HEIGHT
from factors.motion import Increment
from factors.se2 import Array

NamedFactor = tuple[str, BearingRangeFactor]
EXACT = 0.2  # landmarks whose survey has a sigma below this share of `range_sigma` are exact


class KnownLandmarks:
    """Turns measurements into factors. Landmarks that map or rig lack are counted as ignored.

    ``use`` of the map: ``known`` uses its landmarks and ignores others, ``extended`` also estimates the others, ``unknown``
    estimates all landmarks; only their heights are those of the map. ``estimated``: indices of the sensor's constants that
    are estimated. ``carries``: whether the estimator estimates landmarks with an inexact survey; otherwise the survey's
    covariance is added to the noise.
    ``locates``: whether it estimates others that are sighted by range or bearing alone; ``biased``: whether ranges have a bias
    for each landmark.
    """

    def __init__(
        self,
        settings: BearingRangeSettings,
        world: World,
        diagnostics: Diagnostics,
        use: MapUse = "known",
        estimated: tuple[int, ...] = (),
        *,
        carries: bool = False,
        locates: bool = False,
        biased: bool = False,
    ) -> None:
        self._model = settings.model()
        landmarks = {} if use == "unknown" else world.landmarks
        places = dict(zip(world.landmarks, points_of(world.landmarks.values(), settings.z), strict=True))
        self._positions = {name: places[name] for name in landmarks}
        # heights are known where positions are to be estimated
        self._heights = {name: np.concatenate((np.zeros(HEIGHT), place[HEIGHT:])) for name, place in places.items()}
        # of a landmark that is not in the map; with a height of zero if landmarks of the map have one
        self._nowhere = np.zeros_like(next(iter(places.values()), np.zeros(HEIGHT)))
        limit = 2.0 * (EXACT * settings.range_sigma) ** 2
        surveys = {name: m.spread() for name, m in landmarks.items()}
        self._surveys = {name: survey for name, survey in surveys.items() if np.trace(survey) > limit}
        self._carries, self._locates, self._biased = carries, locates, biased
        self._maps_others = use != "known"
        self._estimated = estimated
        self._diagnostics = diagnostics

    def factor(self, m: BearingRange) -> BearingRangeFactor | None:
        """The factor of the landmarks that are not estimated, on the pose at the measurement's time; None without any."""
        return self.factors(m)[0]

    def factors(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> tuple[BearingRangeFactor | None, list[NamedFactor], list[NamedFactor], list[NamedFactor]]:
        """:meth:`factor`, on the pose at the measurement's time or on one that lies ``offset`` before it. Further factors have the
        names of their landmarks. They are of landmarks of the map whose ranges have a bias, of those with an inexact survey, and of
        those without one. The last two depend on the position of the landmark, as the last value.

        ``twist`` (3,): the robot's velocity at that time, needed if the sensor's time offset is estimated.
        """
        fixed, single, surveyed, unknown = self._usable(m)
        count = len(fixed) + len(single) + len(surveyed) + len(unknown)

        def of_rows(rows: list[int], points: Array) -> BearingRangeFactor:
            return BearingRangeFactor(
                self._model,
                points,
                m.range[rows],
                m.bearing[rows],
                None if offset is None else offset.delta,
                None if offset is None else offset.covariance,
                estimated=self._estimated,
                twist=twist,
                in_look=None if offset is None else count,
            )

        def of_row(i: int, *, free: bool) -> NamedFactor:
            name, biased = m.landmarks[i], self._biased and not bool(np.isnan(m.range[i]))
            place = self._positions.get(name, self._heights.get(name, self._nowhere))
            factor = replace(of_rows([i], place[None]), free=free, biased=biased)
            if not free and name in self._surveys:
                factor = replace(factor, point_covariances=self._surveys[name][None])
            return name, factor

        single_factors = (
            [of_row(i, free=False) for i in single],
            [of_row(i, free=True) for i in surveyed],
            [of_row(i, free=True) for i in unknown],
        )
        if not fixed:
            return None, *single_factors
        names = [m.landmarks[i] for i in fixed]
        factor = of_rows(fixed, np.array([self._positions[name] for name in names]))
        if any(name in self._surveys for name in names):
            surveys = np.array([self._surveys.get(name, np.zeros((2, 2))) for name in names])
            factor = replace(factor, point_covariances=surveys)
        return factor, *single_factors

    def _usable(self, m: BearingRange) -> tuple[list[int], list[int], list[int], list[int]]:
        """Rows of landmarks of the map without and with a bias, of those with an inexact survey, and of other landmarks. Rows that
        are not used are counted."""
        fixed, single, surveyed, unknown = list[int](), list[int](), list[int](), list[int]()
        lacks = zip(m.landmarks, np.isnan(m.range).tolist(), np.isnan(m.bearing).tolist(), strict=True)
        for i, (name, no_range, no_bearing) in enumerate(lacks):
            if name not in self._positions:
                if not self._maps_others:
                    self._diagnostics.ignore("landmark not in the map")
                elif (no_range and no_bearing) or ((no_range or no_bearing) and not self._locates):
                    self._diagnostics.ignore("unknown landmark without range and bearing")
                else:
                    unknown.append(i)
            elif no_range and no_bearing:
                self._diagnostics.ignore("neither range nor bearing")
            elif self._carries and name in self._surveys:
                surveyed.append(i)
            else:
                (single if self._biased and not no_range else fixed).append(i)
        return fixed, single, surveyed, unknown

    def survey(self, name: str) -> tuple[Array, Array]:
        """Position (2,) and covariance (2, 2) of a landmark in the map."""
        return self._positions[name][:2], self._surveys[name]
