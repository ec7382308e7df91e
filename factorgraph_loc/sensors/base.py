"""The interface between sensors and estimators.

A sensor that is bound to a run turns a measurement and a view of the estimate into observations. The estimator applies each
before it asks for the next, and lets the sensor judge each correction first. An observation depends on the pose at one time and
on named blocks (constants of a sensor, positions of landmarks). It can be linearised, as a factor of a graph or a correction of a
Gaussian, and evaluated as a likelihood over poses. Neither side depends on the other's implementation."""

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

Blocks = Mapping[str, Array]  # values of blocks by name, or their covariances
Columns = Mapping[str, slice]  # columns of blocks in an error state


@dataclass(frozen=True)
class Term:
    """A factor of a graph with ``rows`` residuals, and the names of the ``blocks`` of its values after the pose, in their order."""

    factor: Factor
    blocks: tuple[str, ...]
    rows: int


class Observation(Protocol):
    """The information of a measurement, or a part of it, on the pose at one time and on named blocks. Immutable.

    ``t`` [s]: time of the measurement; ``found``: number of detections, 0 if there are none. ``is_judged``: whether the sensor
    judges the correction. ``iterations``: number of linearisations, None if the estimator decides.
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
        """The approximate number of elements that enter the likelihood of one pose."""

    @property
    def things(self) -> frozenset[Hashable]:
        """Identifiers of the detected things."""

    @property
    def terms(self) -> Sequence[Term]:
        """The observation as factors of a graph."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of all blocks that the terms depend on."""

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        """The correction of a Gaussian with mean ``pose`` (3,) and ``values`` of the blocks by name.

        ``covariance`` (S, S): of the error state, whose first three components are the body-frame perturbation of the pose;
        ``columns``: those of each block; others are corrected by their correlation. ``iterations``: number of linearisations.
        """

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        """Log-likelihood (N,) up to a constant for ``poses`` (N, 3) and block ``values`` (N, P); other blocks have the rig's
        values."""

    def on_pose(self, values: Blocks, spreads: Blocks) -> Observation:
        """The observation as a function of the pose only, with the blocks fixed at ``values``; their covariances ``spreads`` are
        added to the noise."""

    def at_its_time(self) -> Observation | None:
        """The observation on the pose at its own time, independent of poses at other times; None if that is impossible."""


@dataclass(frozen=True)
class NewVariable:
    """A new block: the position of a landmark that is seen for the first time, or a variable with a prior.

    ``mean`` (d,): initial estimate; ``by_pose`` (d, 3) and ``by_block`` (d, P) by name: its Jacobians; ``noise`` (d, d):
    covariance from the measurement alone. ``sightings``: the observations used, each with the time of its pose. A block with a
    prior has none; ``mean`` and ``noise`` are the prior then.
    """

    name: str
    mean: Array
    by_pose: Array
    by_block: Blocks
    noise: Array
    sightings: tuple[tuple[float, Observation], ...]

    def joint(self, covariance: Array, columns: Columns) -> tuple[Array, Array]:
        """Its covariance (d, S) with an error state of ``covariance`` (S, S), and its own covariance (d, d). ``columns``:
        components of each block in the error state; missing blocks are exact."""
        jacobian = np.zeros((len(self.mean), len(covariance)))
        jacobian[:, :3] = self.by_pose
        for name, block in self.by_block.items():
            if name in columns:
                jacobian[:, columns[name]] = block
        carried = jacobian @ covariance
        return carried, carried @ jacobian.T + self.noise


@dataclass(frozen=True)
class EarlierPose:
    """A pose of an earlier time that an estimator still has: its time ``t`` [s], and the motion from it to the time in question,
    None if these are equal."""

    t: float
    offset: Increment | None


@dataclass(frozen=True)
class Link:
    """A factor on two poses: that which a measurement at ``t`` [s] refers to, its first value, and the one at ``earlier`` [s], its
    second. ``rows``: number of residuals. Only where the view has the earlier pose."""

    t: float
    earlier: float
    factor: Factor
    rows: int


@dataclass(frozen=True)
class Binding:
    """The context of a sensor: a run, the robot's ``motion`` and the diagnostics.

    ``name``: of one of several sensors, the only one of its kind in the setup; "" for the modality. ``use``: how landmarks of the
    map are used, ``points``: how points are used that one measurement does not locate; ``calibration``: which uncertain constants
    the estimator learns.
    """

    setup: Setup
    motion: Motion
    diagnostics: Diagnostics
    use: MapUse = "known"
    points: MapUse = "known"
    calibration: Calibration = "all"
    name: str = ""


class View(Protocol):
    """The current estimate as shown to a sensor, including all observations applied so far.

    ``t`` [s]: time of the pose that observations refer to; ``offset``: the motion from there to the measurement, None if the
    times are equal. ``pose`` (3,) with body-frame ``covariance`` (3, 3): predicted at ``t``. ``newest``: whether there is no
    later pose; ``localized``: whether the robot is localized.
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
        """The estimate (d,) of a block, or None if there is no such block."""

    def block_covariance(self, name: str) -> Array:
        """The covariance (d, d) of an existing block."""

    def joint(self) -> tuple[Array, Columns]:
        """The covariance (S, S) of the error state, and the columns of its blocks."""

    def poses_at(self, times: Array) -> Array:
        """Poses (R, 3) at times (R,) relative to the pose at ``t``."""

    def earlier(self, t: float) -> EarlierPose | None:
        """The pose at or before ``t`` that a :class:`Link` may depend on; None if the estimator has none, as filters have."""


class Finder(Protocol):
    """Finds the pose from the measurements of one sensor without a prediction: at an unknown start or after a kidnapping.

    ``start``: the known start position if only the heading is sought. ``at_once``: whether one measurement may be enough.
    """

    start: KnownPosition | None

    @property
    def at_once(self) -> bool: ...

    @property
    def newest(self) -> ChainState | None:
        """The odometry state at the last informative measurement."""

    @property
    def hypotheses(self) -> Sequence[Mode]:
        """Hypotheses of the pose at that time, most likely first."""

    @property
    def best(self) -> PosePrior | None:
        """The pose if it is unambiguous, else None."""

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Process a measurement while the robot is not localized; False if it is uninformative."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Poses (N, 3) at that time, sampled from the hypotheses."""

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        """Record an observation that is about to be applied to a track; ``view`` shows the prediction."""

    def refuted_since(self, m: Any, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """The time since which the track must have been wrong, checked after a measurement was applied; None if it is not
        refuted.

        ``pose`` (3,) with body-frame ``covariance`` (3, 3): the track at the measurement; ``best`` returns the pose found
        instead.
        """

    def clear(self) -> None:
        """Discard the history: a new track starts, or the current one is trusted."""


class Sensor:
    """A sensor of the robot's surroundings, bound to one run. The defaults are those of a sensor without the feature in question.

    ``modality``: of its measurements; ``name``: of this sensor, by default the modality. ``constants``: those that are
    estimated, as a block with this name; ``follows_constants``: whether their covariance is needed during the run.
    ``finder``: localizes without a prediction. ``bounds`` (2, 2) [m]: lower and upper corner of the area where the robot may
    be, if the sensor can only weigh poses. ``work``: approximate cost of adding a measurement to a graph, where a tag costs
    1. ``evidence_every`` [s]: interval of informative measurements in a search. ``lost``: reason why a track is given up.

    For graphs: ``keyframe_every`` [s]: interval between keyframes; ``gathers``: whether the observations on a pose are merged
    when the next pose begins; ``solve_every`` [s]: longest delay of a solver update; ``links``: whether its factors are on two
    poses (:class:`Link`); many of these may be false.
    """

    modality: ClassVar[str]
    lost: ClassVar[str] = ""
    constants: Estimated = NOTHING
    follows_constants: ClassVar[bool] = False
    keyframe_every: ClassVar[float] = 0.09
    gathers: ClassVar[bool] = False
    links: ClassVar[bool] = False
    evidence_every: ClassVar[float] = 1.0
    work: int = 10
    solve_every: float = 0.0
    finder: Finder | None = None
    bounds: Array | None = None

    def __init__(self, name: str = "") -> None:
        self.name = name or self.modality

    def observe(self, m: Any, view: View) -> Iterator[Observation | NewVariable | Link]:
        """The observations of a measurement; each is applied before the next is requested."""
        raise NotImplementedError

    def judge(self, observation: Any, correction: Correction, view: View) -> bool:
        """Report the innovation, with the prediction in ``view``; False if the observation must not be applied."""
        return True

    def evidence(self, m: Any) -> Observation | None:
        """The information of a measurement on the pose without a prediction; nothing is counted. None if it has none."""
        return None

    @property
    def suspicious_since(self) -> float | None:
        """Time [s] since which the track does not explain the measurements; None if it does."""
        return None

    @property
    def silent(self) -> bool:
        """Whether nothing is detected although something should be."""
        return False

    @property
    def doubts_model(self) -> bool:
        """Whether detections contradict the sensor's model, so that covariances are too small."""
        return False

    def accept(self) -> None:
        """Accept the track although it was suspicious: the model or the map is wrong instead."""

    def gathered(self, observations: Sequence[Any]) -> list[Term]:
        """Merge the observations on one pose into few factors."""
        return [term for observation in observations for term in observation.terms]

    def at_end(self, factor: Factor, width: float) -> Factor | None:
        """A factor for the final solution, its loss ``width`` times as wide; None leaves it out while ``width`` is above 1."""
        return factor

    def convex_width(self, factor: Factor, values: Sequence[Array]) -> float:
        """How many times as wide the loss of a link's factor must be to be convex at ``values``, at least 1."""
        return 1.0

    def rewind(self, t: float) -> None:
        """Forget what came after ``t``; it will be processed again."""

    def restart(self, t: float) -> None:
        """Start a new track at ``t``; later measurements will be processed again."""


WORK = 20  # for a residual: its robust loss takes as long as so many tags


@dataclass(frozen=True)
class ResidualObservation:
    """An observation made of residual factors (:class:`~factors.sighting.SightingFactor`) of one sensor.

    Its log-likelihood is evaluated pose by pose; sensors that need speed with particles override it.
    """

    t: float
    terms: tuple[Term, ...]
    is_judged: ClassVar[bool] = True
    iterations: ClassVar[int | None] = None
    settled: ClassVar[float] = CONVERGED  # m, rad: convergence limit of a step

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
