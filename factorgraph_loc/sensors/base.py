"""What a sensor and an estimator know of each other.

A sensor that is bound to one run turns a measurement, and a view of the estimate, into observations. An estimator applies these,
each before the next is asked for, and lets the sensor judge each correction first. An observation tells of the pose at one time
and of named blocks (constants of a sensor, positions of landmarks); it can be linearised, which makes it a factor of a graph and a
correction of a Gaussian, and weighed over poses. Neither side knows the other by name.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, cast

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.motion import Motion
from factorgraph_loc.model.setup import Calibration, MapUse, Setup
from factorgraph_loc.model.variable import NOTHING, Estimated
from factorgraph_loc.sensors.known_position import KnownPosition
from factors import se2
from factors.graph import Factor
from factors.marginal import Marginalized
from factors.motion import ChainState, Increment
from factors.se2 import Array
from factors.update import CONVERGED, Correction, Sightings, update_state


@dataclass(frozen=True)
class Term:
    """A factor of a graph, with the names of the ``blocks`` that it depends on beside the pose, in the order of its values.

    ``rows``: how many residuals it has.
    """

    factor: Factor
    blocks: tuple[str, ...]
    rows: int


class Observation(Protocol):
    """What a measurement, or a part of it, tells of the pose at one time and of named blocks. It never changes.

    ``t`` [s]: when that was measured; ``found``: how many things were seen, of which 0 is a silence. ``is_judged``: whether the
    sensor wants to judge its correction. ``iterations``: how often it must be linearised,
    None where the estimator chooses.
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
    def things(self) -> frozenset[Hashable]:
        """Names of what was seen."""

    @property
    def terms(self) -> Sequence[Term]:
        """The same as factors of a graph."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of all blocks that the terms depend on."""

    def correct(
        self,
        pose: Array,
        covariance: Array,
        values: Mapping[str, Array],
        columns: Mapping[str, slice],
        iterations: int = 1,
    ) -> Correction:
        """What it makes of a Gaussian: ``pose`` (3,) and the ``values`` of the blocks by name.

        ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation and whose
        ``columns`` are those of each block; what else is in it follows by correlation. ``iterations``: how often it is
        linearised.
        """

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        """Its log-likelihood (N,) up to a constant, for ``poses`` (N, 3) and ``values`` (N, P) of blocks; others are as
        the rig has them."""

    def on_pose(self, values: Mapping[str, Array], spreads: Mapping[str, Array]) -> Observation:
        """The same as an observation of the pose alone, with its blocks at ``values``; their covariances ``spreads`` widen the
        noise."""

    def at_its_time(self) -> Observation | None:
        """The same as an observation of the pose at its own time; None where it does not tell of other places."""


@dataclass(frozen=True)
class NewVariable:
    """A block that begins now: the position of a landmark that was seen for the first time.

    ``mean`` (d,): where it is seen to be; ``by_pose`` (d, 3) and ``by_block`` (d, P) by name: its Jacobians; ``noise`` (d, d): its
    covariance from the measurement alone. ``sightings``: the observations that told it, each with the time of the pose that it
    hangs on; none of a block that begins with a prior, which ``mean`` and ``noise`` are then.
    """

    name: str
    mean: Array
    by_pose: Array
    by_block: Mapping[str, Array]
    noise: Array
    sightings: tuple[tuple[float, Observation], ...]

    def joint(self, covariance: Array, columns: Mapping[str, slice]) -> tuple[Array, Array]:
        """Its covariance (d, S) with an error state of ``covariance`` (S, S), of which the blocks have these ``columns``, and that
        of itself (d, d). Blocks that are not there are exact."""
        jacobian = np.zeros((len(self.mean), len(covariance)))
        jacobian[:, :3] = self.by_pose
        for name, block in self.by_block.items():
            if name in columns:
                jacobian[:, columns[name]] = block
        carried = jacobian @ covariance
        return carried, carried @ jacobian.T + self.noise


@dataclass(frozen=True)
class Binding:
    """What a sensor is bound to: a run, the ``motion`` of its robot, and where to report.

    ``use``: what the map's landmarks are taken for, and ``points`` its points; ``calibration``: which uncertain constants the
    estimator learns.
    """

    setup: Setup
    motion: Motion
    diagnostics: Diagnostics
    use: MapUse = "known"
    points: MapUse = "known"
    calibration: Calibration = "all"


class View(Protocol):
    """What an estimator shows a sensor while it observes: the estimate as it is after all that was applied.

    ``t`` [s]: the time of the pose that observations hang on; ``offset``: the motion from there to the measurement, None where it
    is the same time. ``pose`` (3,) with body-frame ``covariance`` (3, 3): as expected at ``t``. ``newest``: whether no later pose
    was estimated; ``localized``: whether the place is known.
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
        """The estimate (d,) of a block; None where there is none of that name."""

    def spread(self, name: str) -> Array:
        """The covariance (d, d) of a block that there is."""

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        """The covariance (S, S) of the error state, and the columns of each block that it holds."""

    def poses_at(self, times: Array) -> Array:
        """Where the robot was at these times (R,), in the frame of the pose at ``t``, (R, 3)."""


class Finder(Protocol):
    """Finds the pose from what a sensor sees, without a prediction: for an unknown start and for a robot that was carried away.

    ``start``: where the robot began, while only its heading is sought. ``at_once``: one measurement may tell the place.
    """

    start: KnownPosition | None

    @property
    def at_once(self) -> bool: ...

    @property
    def newest(self) -> ChainState | None:
        """The odometry at the last measurement that told something."""

    @property
    def hypotheses(self) -> Sequence[Mode]:
        """Places at that time, the likeliest first."""

    @property
    def best(self) -> PosePrior | None:
        """The one place that is clear, None where there is none."""

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Take a measurement while no place is known; False where it tells nothing."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Poses (N, 3) at that time, drawn from what is known of it."""

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        """Keep what is about to be applied to a track, of which ``view`` shows what was expected."""

    def refuted_since(self, m: Any, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Since when the track must have been wrong, after a measurement was applied to it; None where nothing tells that.

        ``pose`` (3,) with body-frame ``covariance`` (3, 3): of the track at the measurement; ``best`` tells where the robot is.
        """

    def clear(self) -> None:
        """Forget what was seen of a track: another begins, or it is trusted."""


class Sensor:
    """A sensor of the world around the robot, bound to one run. What is here holds for one that has nothing of the kind.

    ``modality``: of the measurements that it takes. ``constants``: those that are estimated, as a block named after the modality;
    ``follows_constants``: whether their covariance is needed on the way, and not at the end alone. ``finder``: tells the place by
    itself. ``bounds`` (2, 2) [m]: lower and upper corner of where the robot may be, of a sensor that only tells how likely a place
    is. ``evidence_every`` [s]: how often its measurements tell something new of a place. ``lost``: why a track is given up.

    Of graphs: ``keyframe_every`` [s]: how often a measurement gets a pose of its own; ``gathers``: whether observations wait on the
    newest pose until the next one, to become few factors then; ``solve_every`` [s]: how long they may wait for the solver.
    """

    modality: ClassVar[str]
    lost: ClassVar[str] = ""
    constants: Estimated = NOTHING
    follows_constants: ClassVar[bool] = False
    keyframe_every: ClassVar[float] = 0.09
    gathers: ClassVar[bool] = False
    evidence_every: ClassVar[float] = 1.0
    solve_every: float = 0.0
    finder: Finder | None = None
    bounds: Array | None = None

    def observe(self, m: Any, view: View) -> Iterator[Observation | NewVariable]:
        """What a measurement tells; each is applied before the next is asked for."""
        raise NotImplementedError

    def judge(self, observation: Any, correction: Correction, view: View) -> bool:
        """Report the innovation, of which ``view`` shows what was expected; False where the observation must not be applied."""
        return True

    def evidence(self, m: Any) -> Observation | None:
        """What a measurement tells of the pose without any prediction; nothing is counted. None for one that is of no use there."""
        return None

    @property
    def suspicious_since(self) -> float | None:
        """Since when [s] the track does not explain what is seen; None if all is well."""
        return None

    @property
    def silent(self) -> bool:
        """Whether nothing is seen where something should be."""
        return False

    def accept(self) -> None:
        """The track is right all the same: the model or the map is not."""

    def gathered(self, observations: Sequence[Any]) -> list[Term]:
        """Observations on one pose as few factors."""
        return [term for observation in observations for term in observation.terms]

    def at_end(self, factor: Factor, width: float) -> Factor | None:
        """A factor of this sensor for the final solution: with what is known by then, and its robust loss ``width`` times as wide
        as it is. None where it is left out while that is more than once, as it has many optima."""
        return factor

    def rewind(self, t: float) -> None:
        """Forget what came after ``t``: it will come once more."""

    def restart(self, t: float) -> None:
        """A new track begins at ``t``: what was seen from then on will come once more."""


@dataclass(frozen=True)
class ResidualObservation:
    """An observation by factors that are residuals (:class:`~factors.update.Sightings`), of one sensor.

    Its log-likelihood is that of the factors, pose by pose: a sensor that is to be fast with particles has one of its own.
    """

    t: float
    terms: tuple[Term, ...]
    is_judged: ClassVar[bool] = True
    iterations: ClassVar[int | None] = None
    settled: ClassVar[float] = CONVERGED  # m, rad: a step that needs no further one

    @property
    def found(self) -> int:
        return sum(term.rows for term in self.terms)

    @property
    def things(self) -> frozenset[Hashable]:
        return frozenset()

    def at_its_time(self) -> Observation | None:
        return None

    @property
    def blocks(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for term in self.terms for name in term.blocks))

    @property
    def factors(self) -> list[Sightings]:
        """The factors of the terms."""
        return [cast(Sightings, term.factor) for term in self.terms]

    @property
    def dof(self) -> int:
        """How many numbers were measured."""
        return sum(factor.dof() for factor in self.factors)

    def correct(
        self,
        pose: Array,
        covariance: Array,
        values: Mapping[str, Array],
        columns: Mapping[str, slice],
        iterations: int = 1,
    ) -> Correction:
        size = max((3, *(columns[name].stop for name in self.blocks)))

        def linearize(delta: Array) -> tuple[Array, Array]:
            at = se2.compose(pose, se2.exp(delta[:3]))
            parts = []
            for term, factor in zip(self.terms, self.factors, strict=True):
                moved = [values[name] + delta[columns[name]] for name in term.blocks]
                residual, (by_pose, *others) = factor.whitened([at, *moved])
                jacobian = np.zeros((*residual.shape, size))
                jacobian[..., :3] = by_pose
                for name, block in zip(term.blocks, others, strict=True):
                    jacobian[..., columns[name]] = block
                parts.append((residual, jacobian))
            return np.concatenate([r for r, _ in parts]), np.concatenate([j for _, j in parts])

        return update_state(linearize, covariance, self.factors[0].weight, iterations, self.dof, self.settled)

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        costs = [
            sum(term.factor.cost([pose, *(values[name][i] for name in term.blocks)]) for term in self.terms)
            for i, pose in enumerate(poses)
        ]
        return -np.array(costs)

    def on_pose(self, values: Mapping[str, Array], spreads: Mapping[str, Array]) -> Observation:
        if not self.blocks:
            return self
        terms = []
        for term in self.terms:
            held = tuple(values[name] for name in term.blocks), tuple(spreads.get(name) for name in term.blocks)
            terms.append(Term(Marginalized(cast(Sightings, term.factor), *held), (), term.rows))
        return ResidualObservation(self.t, tuple(terms))
