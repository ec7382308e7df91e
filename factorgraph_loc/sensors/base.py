"""The interface between sensors and estimators.

A sensor converts a measurement to observations. It reads the current estimate from a view. The estimator applies each
observation before it requests the next one. An observation depends on the pose at one time and on named blocks. A block
is a part of the state other than the pose, such as constants of a sensor or the position of a landmark. An observation
is used as a factor of a graph, as a correction of a Gaussian, or as a likelihood over poses. Sensors and estimators do
not depend on each other."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, cast

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.model.setup import Calibration, MapUse, Setup
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import se2
from factors.graph import Factor
from factors.motion import ChainState, Increment
from factors.se2 import Array
from factors.sighting import Marginalized, SightingFactor
from factors.update import CONVERGED, Correction, update_state

# the value (d,) or the covariance (d, d) of each block of the state, by the name of the block
Blocks = Mapping[str, Array]
Columns = Mapping[str, slice]  # the indices of each block in the vector of the error state, by the name of the block


@dataclass(frozen=True)
class Term:
    """A ``factor`` of the graph on one robot pose and on named blocks of the state (such as a landmark's position).
    ``blocks``: the names of these blocks. ``rows``: the dimension of the residual."""

    factor: Factor
    blocks: tuple[str, ...]
    rows: int


class Observation(Protocol):
    """A measurement, or a part of one, as a constraint on one pose and on blocks of the state (such as a landmark).

    ``t``: time of the measurement [s]. ``found``: number of detections or measured values, possibly 0. ``is_judged``:
    True if the estimator must ask :meth:`Sensor.judge` before it applies the observation. ``iterations``: number of
    linearisations of each correction; None if the estimator decides.
    """

    @property
    def is_judged(self) -> bool: ...
    @property
    def iterations(self) -> int | None: ...
    @property
    def t(self) -> float: ...
    @property
    def found(self) -> int: ...
    @property
    def work(self) -> int:
        """The approximate time to compute the likelihood of one pose, in multiples of the time for one RFID tag."""

    @property
    def things(self) -> frozenset[Hashable]:
        """The identifiers of the detected map elements, such as the indices of tags in the map. Possibly empty."""

    @property
    def terms(self) -> Sequence[Term]:
        """The graph factors that represent the observation, each with the names of the blocks that it depends on."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """The names of all blocks of the state that the observation depends on."""

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        """Return the Kalman correction of a Gaussian estimate of the pose and the blocks by this observation. ``pose``
        (3,) and ``values``, the value (d,) of each block by name: the mean of the estimate. ``covariance`` (S, S): the
        covariance of the error state. The first three components of the error state are the body-frame perturbation of
        the pose. ``columns``: the indices of each block in the error state. ``iterations``: the number of
        linearisations."""

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        """Return the log-likelihood (N,) of ``poses`` (N, 3), up to a constant. ``values``: the values (N, P) of each
        block by name, one row per pose. Calibration constants that are missing in ``values`` are taken from the rig."""

    def on_pose(self, values: Blocks, spreads: Blocks) -> Observation:
        """Return an observation that depends on the pose only. ``values``: the estimates (d,) of all blocks by name.
        ``spreads``: their covariances (d, d) by name, which are added to the noise."""

    def at_its_time(self) -> Observation | None:
        """Return an equivalent observation of the pose at the time ``t`` of the measurement, or None if not
        implemented. The original may depend on an earlier pose and the odometry since then."""


@dataclass(frozen=True)
class NewVariable:
    """A new block ``name`` of the state: the position of a new landmark, or any variable with a prior.

    ``mean`` (d,): the initial estimate. ``by_pose`` (d, 3): its Jacobian by the body-frame perturbation of the pose.
    ``by_block``: its Jacobian (d, P) by each other block, by name. ``noise`` (d, d): its covariance if the pose and
    these blocks were exact. ``sightings``: pairs (time [s], observation) that determine ``mean``. If empty, ``mean``
    and ``noise`` are a prior.
    """

    name: str
    mean: Array
    by_pose: Array
    by_block: Blocks
    noise: Array
    sightings: tuple[tuple[float, Observation], ...]

    def joint(self, covariance: Array, columns: Columns) -> tuple[Array, Array]:
        """Return the cross-covariance (d, S) of this block with the error state, and the covariance (d, d) of this
        block. ``covariance`` (S, S): that of the error state. ``columns``: the indices of other blocks in it."""
        jacobian = np.zeros((len(self.mean), len(covariance)))
        jacobian[:, :3] = self.by_pose
        for name, block in self.by_block.items():
            if name in columns:
                jacobian[:, columns[name]] = block
        carried = jacobian @ covariance
        return carried, carried @ jacobian.T + self.noise


@dataclass(frozen=True)
class EarlierPose:
    """A pose in the state of an estimator at or before a requested time. ``t``: the time of the pose [s]. ``offset``:
    the motion from ``t`` to the requested time, or None if the times are equal."""

    t: float
    offset: Increment | None


@dataclass(frozen=True)
class Link:
    """A ``factor`` on two robot poses: first the pose at ``t`` [s], then the pose at ``earlier`` [s]. ``t``: the time
    of the measurement. ``earlier``: a time that :meth:`View.earlier` returned. ``rows``: the dimension of the
    residual."""

    t: float
    earlier: float
    factor: Factor
    rows: int


@dataclass(frozen=True)
class Binding:
    """The arguments with which a run constructs a :class:`Sensor`.

    ``setup``: rig, map and sensors of the run. ``motion``: the odometry. ``diagnostics``: receives the innovations.
    ``use``: "known" to use the landmarks of the map, "extended" to estimate further landmarks, "unknown" to estimate
    all landmarks. ``points``: the same choice for image points, and for landmarks of which only range or only bearing
    is measured. ``calibration``: which constants are estimated: "all", "none", or "particles" for those that can have
    another value in each particle. ``name``: the name of the sensor if the rig has several of its type, otherwise "".
    """

    setup: Setup
    motion: Motion
    diagnostics: Diagnostics
    use: MapUse = "known"
    points: MapUse = "known"
    calibration: Calibration = "all"
    name: str = ""


class View(Protocol):
    """The estimator's current estimate, for sensors to read while they process a measurement.

    ``t``: time [s] of the pose that new observations must depend on. ``offset``: the motion from ``t`` to the time of
    the measurement, or None if the times are equal. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimate
    at ``t``. ``newest``: True if the estimator has no later pose. ``localized``: True if the robot is localized.
    """

    @property
    def t(self) -> float: ...
    @property
    def offset(self) -> Increment | None: ...
    @property
    def newest(self) -> bool: ...
    @property
    def localized(self) -> bool: ...
    @property
    def pose(self) -> Array: ...
    @property
    def covariance(self) -> Array: ...
    def value(self, name: str) -> Array | None:
        """Return the estimate (d,) of the block ``name`` of the state, or None if the state has no such block."""

    def block_covariance(self, name: str) -> Array:
        """Return the covariance (d, d) of the block ``name``, which must exist in the state."""

    def joint(self) -> tuple[Array, Columns]:
        """Return the covariance (S, S) of the error state of pose and blocks, and the indices of each block in it."""

    def poses_at(self, times: Array) -> Array:
        """Return the robot's poses (R, 3) at ``times`` (R,) [s] by odometry, in the robot frame at the time ``t``."""

    def earlier(self, t: float) -> EarlierPose | None:
        """Return the last pose at or before ``t`` [s] that a :class:`Link` may depend on. Returns None if the state
        contains no such pose. Filters always return None."""


class Finder(Protocol):
    """Global localization by one sensor: finds the pose without a prior, as a run begins or after the robot was
    carried. ``start``: the known start position, or None. With it, only the heading is sought. ``at_once``: True if a
    single measurement can determine the pose."""

    start: KnownPosition | None

    @property
    def at_once(self) -> bool: ...

    @property
    def newest(self) -> ChainState | None:
        """The integrated odometry at the last measurement that gave information, or None before the first one."""

    @property
    def hypotheses(self) -> Sequence[Mode]:
        """Possible poses at the last informative measurement, with weights and covariances, most likely first."""

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last informative measurement with its covariance, or None if the pose is ambiguous."""

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Update ``hypotheses`` and ``best`` with the measurement ``m``. ``odometry``: the odometry state at the time
        of ``m``. Returns False if ``m`` gives no information."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` = N random poses (N, 3) at the last informative measurement, drawn from ``hypotheses``."""

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        """Store ``observation`` for :meth:`refuted_since`. ``odometry``: the odometry state at the time of the
        observation. ``view``: the estimate before the observation corrects it."""

    def refuted_since(self, m: Any, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Return the time [s] since which the estimated pose has been wrong, or None if the estimate may be right. Call
        this after an estimator has processed the measurement ``m``. ``odometry``: the odometry state at the time of
        ``m``. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimate at this time. If it is wrong, the
        attribute ``best`` becomes the correct pose."""

    def clear(self) -> None:
        """Discard the observations of :meth:`follow`. Call this when the estimated pose was replaced or confirmed."""


class Sensor:
    """Base class of exteroceptive sensors. Construct one object for each run. Subclasses override the methods that they
    need. ``name``: the name of the sensor, by default ``modality``. The state block with this name contains the
    sensor's estimated calibration constants."""

    modality: ClassVar[str]  # the kind of the sensor's measurements, such as "rfid"
    lost: ClassVar[str] = ""  # the reason in the message if this sensor rejects the estimated pose
    constants: Estimated = NOTHING  # the calibration constants of the sensor that are estimated
    follows_constants: ClassVar[bool] = False  # True if `observe` needs the covariance of the constants
    keyframe_every: ClassVar[float] = 0.09  # s between the keyframes of a graph
    gathers: ClassVar[bool] = False  # True if a graph must merge the observations of each keyframe by `gathered`
    links: ClassVar[bool] = False  # True if the sensor yields `Link` objects. Many may be false
    evidence_every: ClassVar[float] = 1.0  # s between the measurements that a global localization uses
    work: int = 10  # approximate time to add a measurement to a graph, relative to one RFID tag
    solve_every: float = 0.0  # s; a graph with new measurements is solved after at most this time
    finder: Finder | None = None  # localizes the robot without a prior
    bounds: Array | None = None  # (2, 2) [m]: two corners of the area where particles search

    def __init__(self, name: str = "") -> None:
        self.name = name or self.modality

    def observe(self, m: Any, view: View) -> Iterator[Observation | NewVariable | Link]:
        """Yield the observations of the measurement ``m``. ``view``: the current estimate. The estimator applies each
        yielded object before it requests the next."""
        raise NotImplementedError

    def judge(self, observation: Any, correction: Correction, view: View) -> bool:
        """Return False if the estimator must reject ``observation``, otherwise True. Also record its innovation in the
        diagnostics. ``correction``: the result of :meth:`Observation.correct`. ``view``: the estimate before the
        correction."""
        return True

    def evidence(self, m: Any) -> Observation | None:
        """Return the observation of ``m`` for global localization, or None if ``m`` gives no information."""
        return None

    @property
    def suspicious_since(self) -> float | None:
        """The time [s] since which the measurements contradict the estimated pose, or None if they agree with it."""
        return None

    @property
    def silent(self) -> bool:
        """True if the sensor detects nothing although detections are expected at the estimated pose."""
        return False

    @property
    def doubts_model(self) -> bool:
        """True if the detections contradict the sensor's model. The estimated covariances are then too small."""
        return False

    def accept(self) -> None:
        """Reset ``suspicious_since``. Call this if a global localization has found no better pose, so that the sensor's
        model or the map must be wrong."""

    def gathered(self, observations: Sequence[Any]) -> list[Term]:
        """Return the graph factors of ``observations`` of one pose. A subclass may merge them into fewer factors."""
        return [term for observation in observations for term in observation.terms]

    def at_end(self, factor: Factor, width: float) -> Factor | None:
        """Return the factor that replaces ``factor`` when the whole graph is solved after a run, or None to omit it.
        ``width``: the multiplier of the scale of the robust loss, above 1 in the first steps of graduated
        non-convexity."""
        return factor

    def convex_width(self, factor: Factor, values: Sequence[Array]) -> float:
        """Return the smallest ``width`` of :meth:`at_end` with which the loss of ``factor`` is convex. ``values``: the
        values of the variables of ``factor``, in its order."""
        return 1.0

    def rewind(self, t: float) -> None:
        """Undo the effects of all measurements after ``t`` [s]. The estimator will process these measurements again."""

    def restart(self, t: float) -> None:
        """Reset the sensor. Call this when the estimator replaces its estimate by another pose at ``t`` [s]."""


WORK = 20  # computing time of one residual and its robust loss, relative to one RFID tag


@dataclass(frozen=True)
class ResidualObservation:
    """An observation that consists of residual factors (:class:`~factors.sighting.SightingFactor`) of one sensor.
    ``t``: time [s]. ``terms``: the factors. Limitation: ``log_likelihood`` evaluates one pose after the other."""

    t: float
    terms: tuple[Term, ...]
    is_judged: ClassVar[bool] = True
    iterations: ClassVar[int | None] = None
    settled: ClassVar[float] = CONVERGED  # m, rad: iterations end if a step is smaller than this

    @property
    def found(self) -> int:
        return sum(term.rows for term in self.terms)

    @property
    def work(self) -> int:
        return WORK * self.found

    @property
    def things(self) -> frozenset[Hashable]:
        return frozenset()

    def at_its_time(self) -> Observation | None:
        return None

    @property
    def blocks(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for term in self.terms for name in term.blocks))

    @property
    def factors(self) -> list[SightingFactor]:
        """The factors of all ``terms``."""
        return [cast(SightingFactor, term.factor) for term in self.terms]

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        size = max((3, *(columns[name].stop for name in self.blocks)))

        def linearize(delta: Array) -> tuple[Array, Array]:
            at = se2.moved(pose, delta)
            parts = []
            for term, factor in zip(self.terms, self.factors, strict=True):
                moved = [values[name] + delta[columns[name]] for name in term.blocks]
                residual, (by_pose, *by_values) = factor.whitened([at, *moved])
                jacobian = np.zeros((*residual.shape, size))
                jacobian[..., :3] = by_pose
                for name, block in zip(term.blocks, by_values, strict=True):
                    jacobian[..., columns[name]] = block
                parts.append((residual, jacobian))
            return np.concatenate([r for r, _ in parts]), np.concatenate([j for _, j in parts])

        dof = sum(factor.dof() for factor in self.factors)
        return update_state(linearize, covariance, self.factors[0].weight, iterations, dof, self.settled)

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        costs = [
            sum(term.factor.cost([pose, *(values[name][i] for name in term.blocks)]) for term in self.terms)
            for i, pose in enumerate(poses)
        ]
        return -np.array(costs)

    def on_pose(self, values: Blocks, spreads: Blocks) -> Observation:
        if not self.blocks:
            return self
        terms = []
        for term in self.terms:
            held = tuple(values[name] for name in term.blocks), tuple(spreads.get(name) for name in term.blocks)
            terms.append(Term(Marginalized(cast(SightingFactor, term.factor), *held), (), term.rows))
        return ResidualObservation(self.t, tuple(terms))
