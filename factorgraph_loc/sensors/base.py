"""The interface between sensors and estimators.

A sensor turns a measurement into observations. It sees the current estimate through a view. The estimator applies each
observation before it requests the next one. An observation depends on the pose at one time and on named blocks. A block
is a part of the state other than the pose, such as constants of a sensor or the position of a landmark. An observation
is used as a factor of a graph, as a correction of a Gaussian, or as a likelihood over poses. Sensors do not depend on
estimators, nor estimators on sensors."""

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

# values (d,) of blocks of the state, such as constants of a sensor or a landmark, by the name of the block; or their covariances
Blocks = Mapping[str, Array]
Columns = Mapping[str, slice]  # the components of an error state that belong to each block, by the name of the block


@dataclass(frozen=True)
class Term:
    """A factor of a graph on the pose and on the ``blocks`` of the state with these names. ``rows``: number of its
    residuals."""

    factor: Factor
    blocks: tuple[str, ...]
    rows: int


class Observation(Protocol):
    """Information of a measurement, or of a part of it, on the pose at one time and on blocks of the state. Immutable.

    ``t``: time of the measurement [s]. ``found``: number of detections, possibly 0. ``is_judged``: True if
    :meth:`Sensor.judge` must be called. ``iterations``: number of linearisations, or None if the estimator decides.
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
        """The approximate time to compute the likelihood of one pose, relative to the time for an observation of one RFID tag."""

    @property
    def things(self) -> frozenset[Hashable]:
        """Identifiers of the detected elements of the map, such as landmarks or tags."""

    @property
    def terms(self) -> Sequence[Term]:
        """The observation as factors of a graph."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of all blocks that the terms depend on."""

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        """Return the correction of a Gaussian with mean ``pose`` (3,) and ``values`` of the blocks.

        ``covariance`` (S, S): of the error state, whose first three components are the body-frame perturbation of the
        pose. ``columns``: the components of each block. All other components are corrected through their correlation.
        ``iterations``: the number of linearisations.
        """

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        """Return the log-likelihood (N,), up to a constant, of ``poses`` (N, 3) with ``values`` (N, P) of each block. A
        sensor's constants have the rig's values if their block is missing."""

    def on_pose(self, values: Blocks, spreads: Blocks) -> Observation:
        """Return the observation as a function of the pose only. Blocks are fixed at ``values``, and their covariances
        ``spreads`` are added to the noise."""

    def at_its_time(self) -> Observation | None:
        """Return the observation on the pose at the time of the measurement, or None if it depends on blocks or other poses."""


@dataclass(frozen=True)
class NewVariable:
    """A new block of the state: the position of a landmark that is seen for the first time, or a variable with a prior.

    ``name``: the name of the block. ``mean`` (d,): initial estimate. ``by_pose`` (d, 3) and ``by_block`` (d, P):
    Jacobians of the mean by the pose and by other blocks.
    ``noise`` (d, d): the covariance that results from measurement noise alone. ``sightings``: the observations that the
    estimate consists of, each with the time [s] of its pose. Without sightings, ``mean`` and ``noise`` are a prior.
    """

    name: str
    mean: Array
    by_pose: Array
    by_block: Blocks
    noise: Array
    sightings: tuple[tuple[float, Observation], ...]

    def joint(self, covariance: Array, columns: Columns) -> tuple[Array, Array]:
        """Return the cross-covariance (d, S) of the block with an error state of ``covariance`` (S, S), and the
        covariance (d, d) of the block. ``columns``: the components of each block in the error state. Missing blocks are
        treated as exact."""
        jacobian = np.zeros((len(self.mean), len(covariance)))
        jacobian[:, :3] = self.by_pose
        for name, block in self.by_block.items():
            if name in columns:
                jacobian[:, columns[name]] = block
        carried = jacobian @ covariance
        return carried, carried @ jacobian.T + self.noise


@dataclass(frozen=True)
class EarlierPose:
    """A pose variable of an estimator at or before a requested time. ``t``: its time [s]. ``offset``: the motion from
    ``t`` to the requested time, or None if the times are equal."""

    t: float
    offset: Increment | None


@dataclass(frozen=True)
class Link:
    """A factor on two poses. Its first value is the pose that a measurement at ``t`` [s] refers to. Its second value is
    the pose at ``earlier`` [s], which :meth:`View.earlier` returned. ``rows``: number of its residuals."""

    t: float
    earlier: float
    factor: Factor
    rows: int


@dataclass(frozen=True)
class Binding:
    """The arguments that bind a sensor to a run.

    ``setup``: rig, map and sensors of the run. ``motion``: the odometry. ``diagnostics``: receives the innovations.
    ``use``: known to use the map's landmarks only, extended to estimate other landmarks too, unknown to estimate all landmarks.
    ``points``: as ``use``, for image points and for landmarks that are observed by range alone or bearing alone.
    ``calibration``: which uncertain constants the estimator learns. ``name``: the name of one of several sensors, otherwise "".
    """

    setup: Setup
    motion: Motion
    diagnostics: Diagnostics
    use: MapUse = "known"
    points: MapUse = "known"
    calibration: Calibration = "all"
    name: str = ""


class View(Protocol):
    """The current estimate as a sensor sees it, after all observations applied so far.

    ``t``: time [s] of the pose that new observations depend on. ``offset``: the motion from ``t`` to the measurement,
    None if the times are equal. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimate at ``t``. ``newest``:
    True if the estimator has no later pose. ``localized``: True if the robot is localized.
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
        """Return the estimate (d,) of a block, or None if the estimator has no such block."""

    def block_covariance(self, name: str) -> Array:
        """Return the covariance (d, d) of a block that exists."""

    def joint(self) -> tuple[Array, Columns]:
        """Return the covariance (S, S) of the error state, and the components of each block in it."""

    def poses_at(self, times: Array) -> Array:
        """Return poses (R, 3) by odometry at ``times`` (R,) [s], in the frame of the pose at ``t``."""

    def earlier(self, t: float) -> EarlierPose | None:
        """Return the pose at or before ``t`` [s] that a :class:`Link` may depend on. Returns None if there is none, as
        in filters."""


class Finder(Protocol):
    """Finds the pose from the measurements of one sensor without a prediction: at an unknown start or after a kidnapping.

    ``start``: the known start position if only the heading is sought. ``at_once``: True if one measurement may be enough.
    """

    start: KnownPosition | None

    @property
    def at_once(self) -> bool: ...

    @property
    def newest(self) -> ChainState | None:
        """The odometry state at the last informative measurement, or None."""

    @property
    def hypotheses(self) -> Sequence[Mode]:
        """Hypotheses of the pose at the last informative measurement, most likely first."""

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last informative measurement if it is unambiguous, otherwise None."""

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Process a measurement ``m`` at the odometry state ``odometry``. Returns False if ``m`` is uninformative."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (N, 3) at the last informative measurement, sampled from the hypotheses."""

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        """Record an observation at the odometry state ``odometry``. ``view``: the prediction, not corrected yet."""

    def refuted_since(self, m: Any, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Return the time [s] since which the track must have been wrong, or None. Call this after a measurement was applied.

        ``pose`` (3,) with body-frame ``covariance`` (3, 3): the track at the measurement. If the track is wrong,
        ``best`` is the correct pose.
        """

    def clear(self) -> None:
        """Discard the history, because a new track starts or the current track is trusted."""


class Sensor:
    """A sensor of the robot's surroundings, bound to one run. Sensors derive from this class and override what they need.

    ``name``: the name of the sensor, by default its modality. It is also the name of the block of its estimated constants.
    """

    modality: ClassVar[str]  # the modality of its measurements
    lost: ClassVar[str] = ""  # message: the reason for which the sensor gives up a track
    constants: Estimated = NOTHING  # the constants of the sensor that are estimated
    follows_constants: ClassVar[bool] = False  # True if `observe` needs the covariance of the constants
    keyframe_every: ClassVar[float] = 0.09  # s between the keyframes of a graph
    gathers: ClassVar[bool] = False  # True if a graph must merge the observations of a keyframe by `gathered`
    links: ClassVar[bool] = False  # True if its observations are links between two poses; many links may be false
    evidence_every: ClassVar[float] = 1.0  # s between the measurements that a search of the pose uses
    work: int = 10  # approximate time to add a measurement to a graph, relative to one RFID tag
    solve_every: float = 0.0  # s; longest delay of a solver update of a graph
    finder: Finder | None = None  # localizes the robot without a prediction
    bounds: Array | None = None  # (2, 2) [m]: corners of the area where the robot may be; for a sensor without finder

    def __init__(self, name: str = "") -> None:
        self.name = name or self.modality

    def observe(self, m: Any, view: View) -> Iterator[Observation | NewVariable | Link]:
        """Yield the observations of a measurement. The estimator applies each before it requests the next."""
        raise NotImplementedError

    def judge(self, observation: Any, correction: Correction, view: View) -> bool:
        """Decide whether an observation is applied: returns False to reject it. Also records its innovation.

        ``correction``: the result of :meth:`Observation.correct`, not yet applied. ``view``: the prediction.
        """
        return True

    def evidence(self, m: Any) -> Observation | None:
        """Return the observation of a measurement for the search of an unknown pose, or None without information."""
        return None

    @property
    def suspicious_since(self) -> float | None:
        """The time [s] since which the track does not explain the measurements, or None if it explains them."""
        return None

    @property
    def silent(self) -> bool:
        """True if nothing is detected although detections are expected."""
        return False

    @property
    def doubts_model(self) -> bool:
        """True if detections contradict the sensor's model. Covariances are too small then."""
        return False

    def accept(self) -> None:
        """End the suspicion that the pose is wrong (``suspicious_since``), because a search found no better pose. The
        sensor's model or the map is wrong instead."""

    def gathered(self, observations: Sequence[Any]) -> list[Term]:
        """Merge the observations on one pose into few factors of a graph."""
        return [term for observation in observations for term in observation.terms]

    def at_end(self, factor: Factor, width: float) -> Factor | None:
        """Return the factor for the solution of the whole graph after a run, with the scale of its robust loss times ``width``.

        A width above 1 occurs in the first steps of graduated non-convexity. Returns None to omit the factor in these steps.
        """
        return factor

    def convex_width(self, factor: Factor, values: Sequence[Array]) -> float:
        """Return the multiple (at least 1) of the scale of ``factor``'s loss that makes it convex at ``values``."""
        return 1.0

    def rewind(self, t: float) -> None:
        """Undo the effects of measurements after ``t`` [s], which will be processed again."""

    def restart(self, t: float) -> None:
        """Prepare for a new track at ``t`` [s]. Measurements after ``t`` will be processed again."""


WORK = 20  # computing time of one residual and its robust loss, relative to one RFID tag


@dataclass(frozen=True)
class ResidualObservation:
    """An observation that consists of residual factors (:class:`~factors.sighting.SightingFactor`) of one sensor.

    The log-likelihood is evaluated pose by pose. A sensor that must be fast with particles overrides it.
    """

    t: float
    terms: tuple[Term, ...]
    is_judged: ClassVar[bool] = True
    iterations: ClassVar[int | None] = None
    settled: ClassVar[float] = CONVERGED  # m, rad: iterations end if the step is smaller

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
        """The factors of the terms."""
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
