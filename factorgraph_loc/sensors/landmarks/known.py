"""Converts measurements of landmarks to factors. The map and the rig determine the kind of factor of each landmark."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import MapUse
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeSettings, points_of
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.late import NONE, LateRanges
from factors.landmarks.model import HEIGHT, with_late
from factors.motion import Increment
from factors.se2 import Array

NamedFactor = tuple[str, BearingRangeFactor]
EXACT = 0.2  # a survey is treated as exact if its standard deviation is below this fraction of `range_sigma`


class KnownLandmarks:
    """Converts measurements of landmarks to factors. Sightings that cannot be used are counted in ``diagnostics``.

    ``use``: how the map is used. "known": landmarks that are not in the map are ignored. "extended": they are
    estimated. "unknown": all landmarks are estimated, and only their heights are taken from the map. ``estimated``:
    indices of the sensor's constants that are estimated. ``carries``: True if the positions of mapped landmarks with an
    inexact survey are part of the state. Otherwise the covariance of the survey is added to the noise. ``locates``:
    True if the estimator can locate new landmarks from ranges alone or bearings alone. ``biased``: True to estimate a
    range bias of each landmark.
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
        # the height is taken from the map even if the position is estimated
        self._heights = {name: np.concatenate((np.zeros(HEIGHT), place[HEIGHT:])) for name, place in places.items()}
        # position of landmarks that are not in the map, until they are located; height 0 if the map has heights
        self._nowhere = np.zeros_like(next(iter(places.values()), np.zeros(HEIGHT)))
        limit = 2.0 * (EXACT * settings.range_sigma) ** 2
        surveys = {name: m.spread() for name, m in landmarks.items()}
        self._surveys = {name: survey for name, survey in surveys.items() if np.trace(survey) > limit}
        self._carries, self._locates, self._biased = carries, locates, biased
        self._maps_others = use != "known"
        self._estimated = estimated
        self._diagnostics = diagnostics

    def factor(self, m: BearingRange) -> BearingRangeFactor | None:
        """Return one factor of all mapped landmarks in ``m`` that are not estimated, or None without such landmarks.
        The factor depends on the pose at the time of ``m``."""
        return self.factors(m)[0]

    def factors(
        self,
        m: BearingRange,
        offset: Increment | None = None,
        twist: Array | None = None,
        late: LateRanges = NONE,
    ) -> tuple[BearingRangeFactor | None, list[NamedFactor], list[NamedFactor], list[NamedFactor]]:
        """Return the factors of the measurement ``m``, in four groups. Groups 2 to 4 contain pairs (name, factor).

        1. One factor of all mapped landmarks that are not estimated, or None without such landmarks.
        2. One factor for each mapped landmark with a range bias. It also depends on the bias.
        3. One factor for each mapped landmark with an inexact survey. It also depends on the landmark's position.
        4. One factor for each landmark with an unknown position. It also depends on the landmark's position.

        ``offset``: the motion from the pose that the factors depend on to the measurement, None if the times are equal.
        ``twist`` (3,): the robot's velocity at the measurement, required if the sensor's time offset is estimated.
        ``late``: the estimated statistics of late ranges, which are too long because the signal was reflected.
        """
        fixed, single, surveyed, unknown = self._usable(m)
        model = with_late(self._model, late)
        count = len(fixed) + len(single) + len(surveyed) + len(unknown)

        def of_rows(rows: list[int], points: Array) -> BearingRangeFactor:
            whole = len(rows) == len(m.range)
            return BearingRangeFactor(
                model,
                points,
                m.range if whole else m.range[rows],
                m.bearing if whole else m.bearing[rows],
                None if offset is None else offset.delta,
                None if offset is None else offset.covariance,
                estimated=self._estimated,
                twist=twist,
                simultaneous=None if offset is None else count,
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
        """Return four lists: the row indices of the landmarks in ``m`` for each group of :meth:`factors`. Other rows
        are counted in the diagnostics."""
        fixed, single, surveyed, unknown = list[int](), list[int](), list[int](), list[int]()
        rows = zip(m.landmarks, m.range.tolist(), m.bearing.tolist(), strict=True)
        for i, (name, range_, bearing) in enumerate(rows):
            no_range, no_bearing = math.isnan(range_), math.isnan(bearing)
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
        """Return the position (2,) [m] and covariance (2, 2) of the landmark ``name``, which has an inexact survey."""
        return self._positions[name][:2], self._surveys[name]
