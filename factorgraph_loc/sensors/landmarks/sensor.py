"""The landmark sensor of a run."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, cast

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import GOING_BACK
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.model.setup import MapUse
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.base import Binding, Blocks, Columns, NewVariable, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.landmarks.finder import LandmarkFinder
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeSettings, points_of
from factors import positive
from factors.graph import Factor
from factors.landmarks.factor import BearingRangeFactor, landmark_update
from factors.landmarks.kernels import innovations
from factors.landmarks.model import PARAMETERS, TIME_OFFSET
from factors.motion import Increment
from factors.se2 import Array
from factors.update import GATE, Correction

NamedFactor = tuple[str, BearingRangeFactor]
NOWHERE = np.zeros(2)  # of a landmark that is not in the map
EXACT = 0.2  # landmarks whose survey has a sigma below this share of `range_sigma` are exact


class KnownLandmarks:
    """Turns measurements into factors. Landmarks that map or rig lack are counted as ignored.

    ``use`` of the map: ``known`` uses its landmarks and ignores others, ``extended`` also estimates the others, ``unknown``
    estimates all landmarks without the map. ``estimated``: indices of the sensor's constants that are estimated. ``carries``:
    whether the estimator estimates landmarks with an inexact survey; otherwise the survey's covariance is added to the noise.
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
    ) -> None:
        self._model = settings.model()
        landmarks = {} if use == "unknown" else world.landmarks
        self._positions = dict(zip(landmarks, points_of(landmarks.values(), settings.z), strict=True))
        limit = 2.0 * (EXACT * settings.range_sigma) ** 2
        surveys = {name: m.spread() for name, m in landmarks.items()}
        self._surveys = {name: survey for name, survey in surveys.items() if np.trace(survey) > limit}
        self._carries = carries
        self._maps_others = use != "known"
        self._estimated = estimated
        self._diagnostics = diagnostics

    def factor(self, m: BearingRange) -> BearingRangeFactor | None:
        """The factor of the landmarks that are not estimated, on the pose at the measurement's time; None without any."""
        return self.factors(m)[0]

    def factors(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> tuple[BearingRangeFactor | None, list[NamedFactor], list[NamedFactor]]:
        """:meth:`factor`, on the pose at the measurement's time or on one that lies ``offset`` before it. Further factors depend
        on the pose and, as the last value, on the position of a landmark. They have names, and are of landmarks with an inexact
        survey, then of those without one.

        ``twist`` (3,): the robot's velocity at that time, needed if the sensor's time offset is estimated.
        """
        fixed, surveyed, unknown = list[int](), list[int](), list[int]()
        lacks = zip(m.landmarks, np.isnan(m.range).tolist(), np.isnan(m.bearing).tolist(), strict=True)
        for i, (name, no_range, no_bearing) in enumerate(lacks):
            if name not in self._positions:
                if not self._maps_others:
                    self._diagnostics.ignore("landmark not in the map")
                elif no_range or no_bearing:
                    self._diagnostics.ignore("unknown landmark without range and bearing")
                else:
                    unknown.append(i)
            elif no_range and no_bearing:
                self._diagnostics.ignore("neither range nor bearing")
            else:
                (surveyed if self._carries and name in self._surveys else fixed).append(i)

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
                in_look=None if offset is None else len(fixed) + len(surveyed) + len(unknown),
            )

        of_surveyed, of_unknown = (
            [
                (m.landmarks[i], replace(of_rows([i], self._positions.get(m.landmarks[i], NOWHERE)[None]), free=True))
                for i in rows
            ]
            for rows in (surveyed, unknown)
        )
        if not fixed:
            return None, of_surveyed, of_unknown
        names = [m.landmarks[i] for i in fixed]
        factor = of_rows(fixed, np.array([self._positions[name] for name in names]))
        if any(name in self._surveys for name in names):
            surveys = np.array([self._surveys.get(name, np.zeros((2, 2))) for name in names])
            factor = replace(factor, point_covariances=surveys)
        return factor, of_surveyed, of_unknown

    def survey(self, name: str) -> tuple[Array, Array]:
        """Position (2,) and covariance (2, 2) of a landmark in the map."""
        return self._positions[name][:2], self._surveys[name]


def together(factors: Sequence[BearingRangeFactor]) -> BearingRangeFactor:
    """Merge the factors of one measurement on one pose."""
    first, *rest = factors
    if not rest:
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


SURVEYED_ITERATIONS = 4
WORK = 8  # of a landmark, per pose, if a compiled call weighs many poses
SMALL = 40  # size of error states whose matrices are inverted by compiled code
MAX_PENDING = 5  # sightings per landmark that wait for another to agree


@dataclass(frozen=True)
class LandmarkObservation(ResidualObservation):
    """Landmarks seen at one time: one term for those of the map, and one term for each other landmark. ``surveyed``: some have a
    survey prior, which requires several linearisations if the first sighting is from afar."""

    surveyed: bool = False

    @property
    def work(self) -> int:
        return WORK * self.found

    @property
    def iterations(self) -> int | None:  # type: ignore[override]
        return SURVEYED_ITERATIONS if self.surveyed else None

    @property
    def measured(self) -> BearingRangeFactor:
        """All landmarks as one factor."""
        return together([cast(BearingRangeFactor, term.factor) for term in self.terms])

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        term = self.terms[0]
        if len(self.terms) == 1 and len(covariance) <= SMALL:
            held, first = (values[term.blocks[0]], columns[term.blocks[0]].start) if term.blocks else (np.zeros(0), 3)
            factor = cast(BearingRangeFactor, term.factor)
            update = landmark_update(factor, pose, covariance, held, first, iterations, self.settled)
            if update is not None:
                return update
        return super().correct(pose, covariance, values, columns, iterations)

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        total = np.zeros(len(poses))
        for term in self.terms:
            factor, at, parameters = cast(BearingRangeFactor, term.factor), poses, None
            if factor.estimated and term.blocks[0] in values:
                parameters = np.zeros((len(poses), len(PARAMETERS)))
                parameters[:, list(factor.estimated)] = values[term.blocks[0]]
            if factor.free:  # an error of the landmark's position is equivalent to one of the robot's
                places = values[term.blocks[-1]]
                factor, at = replace(factor, points=places[:1]), poses.copy()
                at[:, :2] -= places - places[0]
            total += factor.log_likelihood(at, parameters)
        return total

    @property
    def things(self) -> frozenset[Hashable]:
        return frozenset(map(tuple, self.measured.points.tolist()))

    def at_its_time(self) -> Self | None:
        """The landmarks of the map, on the pose at the time of the measurement."""
        if self.blocks:
            return None
        factor = self.measured
        return replace(
            self, terms=(replace(self.terms[0], factor=replace(factor, offset=None, offset_covariance=None)),)
        )

    def on_pose(self, values: Blocks, spreads: Blocks) -> Self:
        """The observation on the pose only: constants are fixed, other landmarks have covariances ``spreads``."""
        if len(self.terms) == 1 and not self.terms[0].blocks:
            return self
        fixed = []
        for term in self.terms:
            factor = cast(BearingRangeFactor, term.factor)
            shared = [values[name] for name in term.blocks[: len(term.blocks) - factor.free]]
            own = term.blocks[-1] if factor.free else None
            here = factor.fixed(shared, None if own is None else values[own])
            fixed.append(here if own is None else replace(here, point_covariances=spreads[own][None]))
        factor = together(fixed)
        return type(self)(self.t, (Term(factor, (), 2 * len(factor.points)),), self.surveyed)


Sighted = tuple[float, LandmarkObservation]  # with the time [s] of the pose that saw it


@dataclass(frozen=True)
class NewLandmarks:
    """Sightings of landmarks that are not initialized yet: two must agree on the position, because one may be an outlier.

    Immutable, because filters go back to an earlier state when a measurement is late.
    """

    pending: Mapping[str, tuple[tuple[Array, Array, Sighted], ...]] = field(default_factory=dict)

    def propose(
        self, name: str, point: Array, covariance: Array, sighting: Sighted
    ) -> tuple[NewLandmarks, Sighted | None]:
        """Add a sighting that puts the landmark at ``point`` (2,) with ``covariance`` (2, 2). Returns the new pending sightings,
        and an earlier sighting that agrees, or None."""
        waiting = self.pending.get(name, ())
        for earlier, noise, candidate in reversed(waiting):
            apart = point - earlier
            if positive.squared(apart, noise + covariance) < GATE:
                return NewLandmarks({key: rows for key, rows in self.pending.items() if key != name}), candidate
        return NewLandmarks({**self.pending, name: (*waiting, (point, covariance, sighting))[-MAX_PENDING:]}), None


class LandmarkSensor(Sensor):
    """Identified landmarks. For ``use`` of the map see :class:`KnownLandmarks`. A landmark that is not in the map becomes a block
    ``bearing_range/NAME``, which all sensors of the kind share, once two sightings agree on its position."""

    modality = "bearing_range"
    lost = "landmarks were not where they were expected"

    def __init__(self, binding: Binding, settings: BearingRangeSettings, constants: Estimated) -> None:
        super().__init__(binding.name)
        world, motion, use = binding.setup.world, binding.motion, binding.use
        self.constants, self._motion, self._diagnostics = constants, motion, binding.diagnostics
        self._landmarks = KnownLandmarks(settings, world, self._diagnostics, use, constants.indices, carries=True)
        # sightings before the start are counted when they are used there
        self._sought = KnownLandmarks(settings, world, Diagnostics())
        self._shared = (self.name,) if constants.names else ()
        self._new: NewLandmarks = NewLandmarks()
        self._before: deque[tuple[float, NewLandmarks]] = deque()
        self._finder: LandmarkFinder | None = None
        if use == "known" and world.landmarks:
            self.finder = self._finder = LandmarkFinder(self._sought.factor, motion, world.positions())

    def observe(self, m: BearingRange, view: View) -> Iterator[LandmarkObservation | NewVariable]:
        twist = self._motion.twist(m.t) if TIME_OFFSET in self.constants.indices else None
        known, inexact, unknown = self._landmarks.factors(m, view.offset, twist)
        terms = [] if known is None else [Term(known, self._shared, 2 * len(known.points))]
        for name, factor in inexact:
            block, (position, spread) = f"{self.modality}/{name}", self._landmarks.survey(name)
            if view.value(block) is None:
                yield NewVariable(block, position, np.zeros((2, 3)), {}, spread, ())
            if view.value(block) is None:  # the estimator does not estimate it
                prior = replace(factor, point_covariances=spread[None], free=False)
                terms.append(Term(prior, self._shared, 2))
            else:
                terms.append(Term(factor, (*self._shared, block), 2))
        surveyed = any(term.blocks != self._shared for term in terms)
        met: list[tuple[str, Term]] = []
        for name, factor in unknown:
            block = f"{self.modality}/{name}"
            term = Term(factor, (*self._shared, block), 2)
            if view.value(block) is None:
                met.append((block, term))
            else:
                terms.append(term)
        if terms:
            yield LandmarkObservation(m.t, tuple(terms), surveyed)
        for block, term in met if view.newest else ():
            new = self._proposed(m.t, block, term, view)
            if new is not None:
                yield new

    def _proposed(self, t: float, block: str, term: Term, view: View) -> NewVariable | None:
        """A new landmark if an earlier sighting agrees with this one, with its position from this sighting."""
        shared = [value for name in self._shared if (value := view.value(name)) is not None]
        point, (by_pose, *by_shared), noise = cast(BearingRangeFactor, term.factor).locate([view.pose, *shared])
        current = (view.t, LandmarkObservation(t, (term,)))
        new = NewVariable(block, point, by_pose, dict(zip(self._shared, by_shared, strict=True)), noise, (current,))
        _, widened = new.joint(*view.joint())
        self._before.append((t, self._new))
        while self._before[0][0] < t - GOING_BACK:
            self._before.popleft()
        self._new, earlier = self._new.propose(block, point, widened, current)
        return None if earlier is None else replace(new, sightings=(earlier, current))

    def judge(self, observation: LandmarkObservation, correction: Correction, view: View) -> bool:
        factor = observation.measured
        self._diagnostics.innovation(self.name, observation.t, correction.nis, correction.dof)
        ranges, bearings = innovations(factor.model.packed, correction.residual, factor.ranges, factor.bearings)
        self._diagnostics.add_residuals(f"{self.name}.range", ranges.tolist())
        self._diagnostics.add_residuals(f"{self.name}.bearing", bearings.tolist())
        return True

    @property
    def suspicious_since(self) -> float | None:
        return None if self._finder is None else self._finder.suspicious_since

    def accept(self) -> None:
        if self._finder is not None:
            self._finder.clear()

    def evidence(self, m: BearingRange) -> LandmarkObservation | None:
        factor = self._sought.factor(m)
        return None if factor is None else LandmarkObservation(m.t, (Term(factor, (), 2 * len(factor.points)),))

    def at_end(self, factor: Factor, width: float) -> Factor:
        return cast(BearingRangeFactor, factor).widened(width)

    def rewind(self, t: float) -> None:
        while self._before and self._before[-1][0] > t:
            _, self._new = self._before.pop()

    def restart(self, t: float) -> None:
        self._new = NewLandmarks()
        self._before.clear()


def bind(binding: Binding) -> LandmarkSensor | None:
    """The sensor of a run, or None if it is not used. With particles its time offset is not estimated."""
    settings = binding.setup.rig.find(BearingRangeSettings)
    if settings is None or LandmarkSensor.modality not in binding.setup.sensors:
        return None
    names = PARAMETERS[:TIME_OFFSET] if binding.calibration == "particles" else PARAMETERS
    uncertainty = None if binding.calibration == "none" else settings.uncertainty
    return LandmarkSensor(binding, settings, Estimated.of(names, uncertainty))
