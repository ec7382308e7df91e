"""Simulation of a robot that starts at an unknown pose and chooses its paths until it is localized (closed loop)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from scipy.spatial import cKDTree

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.fusion import registry
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.fusion.cloud import systematic
from factorgraph_loc.fusion.guarded import Guard, sound
from factorgraph_loc.maps.free_space import CELL, FreeSpace, distance_to_walls, free_space
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import Belief, Mode, PoseEstimate
from factorgraph_loc.model.measurement import Measurement, Tick, channel_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.planning.active_mcl import ActiveMcl
from factorgraph_loc.planning.information import Sensors
from factorgraph_loc.planning.paths import Path, full_turn, primitives, waypoint_paths, waypoints
from factorgraph_loc.planning.policies import Choice, Policy, Situation, usable
from factorgraph_loc.planning.policies import policy as named_policy
from factorgraph_loc.planning.robot import SimulatedRobot
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS
from factorgraph_loc.sensors.odometry.simulation import RATE
from factorgraph_loc.sensors.registry import sensors
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.simulation.simulate import generator
from factorgraph_loc.simulation.worlds import Plan, make_plan, make_world
from factorgraph_loc.text import quoted
from factors import se2
from factors.se2 import Array

NEXT, NEXT_HEADING = 3.0, 1.0  # m, rad: modes with smaller differences are merged
SHOWN = 300  # number of particles of a belief that are stored in the result
SAMPLES = 2000  # number of particles that are drawn from a belief without particles
WRONG = 3.0  # a localized estimate counts as wrong if an error exceeds this multiple of its limit in the settings
MODES, LIKELY = 3, 0.05  # policies know at most this many modes, each with at least this weight
WAYPOINTS = 40  # number of places that are spread over free space
TAGS, PLACES = 8, 6  # paths are planned to this many nearest tags and nearest waypoints
READING_DISTANCE = 0.5  # m driven between two readings of the proximity sensor
PAUSE = 1.0  # s that the robot waits if no path is free
SLACK = 0.2  # m, one cell of the grid of free space: particles may be nearer to walls than the robot by this distance


@dataclass(frozen=True)
class PlanningStep:
    """One choice of a path by a policy.

    ``t`` [s], ``metres`` [m]: time and driven distance. ``truth`` (3,): the true pose.
    ``pose`` (3,), ``covariance`` (3, 3): the estimate in the world frame, NaN before the first observation.
    ``particles`` (K, 3): an equally weighted sample of the belief.
    ``candidates``: the C proposed paths as poses (S, 3) in the world frame, starting at the true pose.
    ``values`` (C,): the policy's scores of the candidates, higher is better. Empty if the policy does not compare them.
    ``chosen``: the poses of the chosen path, None if no path was free. ``planning_ms`` [ms]: the computing time.
    """

    t: float
    metres: float
    truth: Array
    pose: Array
    covariance: Array
    particles: Array
    candidates: tuple[Array, ...]
    values: Array
    chosen: Array | None
    planning_ms: float


@dataclass(frozen=True)
class ActiveRun:
    """The result of a run of one policy with one estimator in one simulated world.

    ``seed``: the seed of the random numbers. ``preset``: the name of the simulation's settings. ``localized``: True if
    the run ended because the robot was localized correctly. ``metres`` [m], ``seconds`` [s]: driven distance and time
    at the end of the run. ``error_position`` [m], ``error_heading`` [rad]: the errors of the last estimate.
    ``claimed_wrong``: True if an estimate with the status ``localized`` had an error above :data:`WRONG` times
    ``position_limit`` or ``heading_limit`` of the settings. ``truth``: the true trajectory. ``steps``: the choices of
    paths.
    """

    seed: int
    preset: str
    world: World
    policy: str
    estimator: str
    localized: bool
    metres: float
    seconds: float
    error_position: float
    error_heading: float
    claimed_wrong: bool
    truth: Trajectory
    steps: tuple[PlanningStep, ...]

    @property
    def planning_ms(self) -> Array:
        """The computing times (N,) [ms] of the N choices."""
        return np.array([step.planning_ms for step in self.steps])


def run_active(
    simulation: SimulationSettings, policy: str, estimator: str, seed: int, settings: ActiveSettings | None = None
) -> ActiveRun:
    """Return the result of a simulated drive from an unknown start, which ends when the robot is localized or reaches a
    limit.

    ``policy``, ``estimator``: names. ``simulation``: settings of the world and the sensors. ``settings``: of the active
    run; None means the defaults. Runs with the same ``seed`` have the same world, start and noise sequences.

    Raises InputError for an unknown name, a start that is not free, or a sensor that is faster than the robot's
    control. Raises RunFailedError if the estimator fails.
    """
    loop = _ClosedLoop(simulation, policy, estimator, seed, settings or ActiveSettings())
    localized = loop.run()
    position, heading = loop.errors()
    robot = loop.robot
    return ActiveRun(
        seed=seed,
        preset=simulation.name,
        world=loop.world,
        policy=policy,
        estimator=estimator,
        localized=localized,
        metres=robot.metres,
        seconds=robot.t,
        error_position=position,
        error_heading=heading,
        claimed_wrong=loop.claimed_wrong,
        truth=robot.trajectory(),
        steps=tuple(loop.steps),
    )


class _ClosedLoop:
    """A simulated run. In each step a policy chooses a path, the robot drives it, and the measurements update the
    estimate."""

    def __init__(
        self, simulation: SimulationSettings, policy: str, estimator: str, seed: int, settings: ActiveSettings
    ) -> None:
        for name, rate in _rates(simulation):
            if rate > RATE:
                raise InputError(
                    f"{simulation.name}: {name} is {rate:g} Hz, expected at most {RATE:g} Hz, the rate of the robot's control"
                )
        self._policy: Policy = named_policy(policy)

        def of_world() -> np.random.Generator:
            return generator(seed if simulation.world_seed is None else simulation.world_seed, "world")

        self.world = world = make_world(simulation.world, of_world())
        self._space = space = free_space(world, settings.clearance)
        of_start, of_robot, of_estimator, self._rng = np.random.default_rng((seed, 1)).spawn(4)
        start = _start(make_plan(simulation.world, of_world()), world, space, settings, of_start)
        self.robot = robot = SimulatedRobot(world, space, simulation, start, settings, of_robot)
        setup = model_setup.Setup(simulation.rig, world, robot.channels, of_estimator)
        self._guard = Guard(f"{estimator} on {simulation.name}")
        with self._guard:
            self._estimator = _estimator(estimator, setup, settings)
        self.steps: list[PlanningStep] = []
        self.claimed_wrong = False
        self._settings = settings
        self._paths, self._turn = primitives(settings.policy.horizon), full_turn()
        self._proximity_at = -math.inf  # m: the driven distance at the last reading of the proximity sensor
        self._turned_at = -math.inf  # m: the driven distance at the last full turn in place
        self._sensors = Sensors.of(
            world, simulation.rig, simulation, settings.speed, settings.turn_rate, only=robot.sensors
        )
        # targets of paths: the free cell nearest to each tag, and places spread over free space
        nearest_cells = cKDTree(space.centres).query(self._sensors.goals)[1]
        self._targets = ((space.centres[np.unique(nearest_cells)], TAGS), (waypoints(space, WAYPOINTS), PLACES))

    def run(self) -> bool:
        """Run until the robot is localized or reaches a limit. Returns True if the robot was localized correctly."""
        robot, settings = self.robot, self._settings
        done = self._take(robot.begin())
        while not done and robot.metres < settings.max_metres - 1e-3 and robot.t < settings.max_seconds:
            choice = self._choose()
            begin = robot.t
            if choice.path is not None:
                metres = min(choice.metres, settings.max_metres - robot.metres)
                done = self._take(robot.drive(choice.path.poses, metres))
            if robot.t == begin:
                done = self._take(robot.wait(PAUSE))
        self._feed(Tick(robot.t))
        return done

    def errors(self) -> tuple[float, float]:
        """Return the errors of the estimate in position [m] and heading [rad]. They are NaN if there is no estimate."""
        error = self._estimate().pose - self.robot.pose
        return float(np.hypot(*error[:2])), float(abs(se2.wrap(error)[2]))

    def _take(self, reports: Iterator[Measurement]) -> bool:
        """Process the measurements ``reports`` of the robot. Return True as soon as the robot is localized correctly,
        and False after the last measurement."""
        for report in reports:
            self._feed(report)
            if isinstance(self._estimator, ActiveMcl) and self.robot.metres >= self._proximity_at + READING_DISTANCE:
                self._proximity_at = self.robot.metres
                # a tick moves the particles to the current time, because odometry alone does not move them
                self._feed(Tick(self.robot.t))
                with self._guard.computing("the walls", self.robot.t):
                    self._estimator.see(self.robot.proximity, self.robot.read_proximity())
            if channel_of(report) in self.robot.decisive and self._is_sure():
                position, heading = self.errors()
                if position < self._settings.position_limit and heading < self._settings.heading_limit:
                    return True
                beyond = max(position / self._settings.position_limit, heading / self._settings.heading_limit)
                self.claimed_wrong |= beyond > WRONG
        return False

    def _feed(self, measurement: Measurement) -> None:
        self._guard.process(self._estimator, measurement)

    def _estimate(self) -> PoseEstimate:
        with self._guard.computing("the estimate", self.robot.t):
            return sound(self._estimator.estimate())

    def _is_sure(self) -> bool:
        estimate = self._estimate()
        if estimate.status != "localized":
            return False
        position = math.sqrt(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])
        heading = math.sqrt(estimate.covariance[2, 2])
        return position < self._settings.position_limit and heading < self._settings.heading_limit

    def _choose(self) -> Choice:
        self._feed(Tick(self.robot.t))
        started = perf_counter()
        with self._guard.computing("the belief", self.robot.t):
            belief = self._estimator.belief()
        particles, weights = _sampled(belief, self._space, self._rng)
        modes = _main_modes(belief)
        proposed = [*self._paths, *self._far_paths(modes)]
        if self.robot.metres >= self._turned_at + self._settings.policy.replan:
            proposed.append(self._turn)
        paths, free = usable(proposed, self.robot.free_ahead(proposed), self._settings.sight)
        situation = Situation(
            particles, weights, self._sensors, self._space, paths, free, self._settings, self._rng, modes
        )
        choice = self._policy(situation)
        elapsed = 1e3 * (perf_counter() - started)
        if choice.path is not None and choice.path.kind == self._turn.kind:
            self._turned_at = self.robot.metres
        estimate = self._estimate()
        self.steps.append(
            PlanningStep(
                t=self.robot.t,
                metres=self.robot.metres,
                truth=self.robot.pose.copy(),
                pose=estimate.pose,
                covariance=estimate.covariance,
                particles=particles[systematic(weights, self._rng, min(SHOWN, len(weights)))],
                candidates=tuple(self._in_world(path) for path in paths),
                values=choice.values,
                chosen=None if choice.path is None else self._in_world(choice.path),
                planning_ms=elapsed,
            )
        )
        return choice

    def _far_paths(self, modes: Sequence[Mode]) -> list[Path]:
        """Return the shortest paths from each mode to distant tags and to distant places in free space."""
        out: list[Path] = []
        policy = self._settings.policy
        for mode in modes:
            for places, count in self._targets:
                out += waypoint_paths(
                    self._space, mode.pose, places, nearest=count, beyond=policy.horizon, within=policy.far
                )
        return out

    def _in_world(self, path: Path) -> Array:
        return np.asarray(se2.compose(self.robot.pose, path.poses))


def _rates(simulation: SimulationSettings) -> Iterator[tuple[str, float]]:
    """Yield the names of those settings in ``simulation`` that are rates of sensors, with the rates [Hz]."""
    yield "rounds_per_second", simulation.rounds_per_second
    for sensor in sensors().values():
        for section in sensor.simulation if sensor.on_robot else ():
            yield f"{section}.rate", getattr(getattr(simulation, section), "rate", 0.0)


def _estimator(name: str, setup: model_setup.Setup, settings: ActiveSettings) -> Estimator:
    if name == "active_mcl":
        space = free_space(setup.world, max(settings.clearance - SLACK, 0.0))
        return ActiveMcl(setup, settings.particles, space)
    if name not in ACTIVE_ESTIMATORS:
        raise InputError(
            f"estimator {quoted(name)} is not known for active runs{nearest(name, list(ACTIVE_ESTIMATORS))}"
        )
    return registry.create(name, setup, registry.settings_of(name, {}))


def _start(plan: Plan, world: World, space: FreeSpace, settings: ActiveSettings, rng: np.random.Generator) -> Array:
    """Return the true start pose (3,): the setting ``start``, or a random pose in ``space`` if it is not set. Raises
    InputError if the setting is not in free space."""
    place = space.centres[rng.integers(len(space.centres))] + CELL * (rng.random(2) - 0.5)
    drawn = np.array((*place, rng.uniform(-math.pi, math.pi)))
    if settings.start is None:
        return drawn
    x, y, _ = settings.start
    place = np.array(((x, y),))
    gap = float(distance_to_walls(world, place)[0])
    if gap < settings.clearance or not plan.open(place)[0]:
        raise InputError(
            f"{world.name}: start ({x:g}, {y:g}) is in a solid object, outside of the building, or {gap:.2f} m from a wall: "
            f"set start to a free place at least {settings.clearance:g} m from all walls"
        )
    return np.array(settings.start)


def _main_modes(belief: Belief) -> tuple[Mode, ...]:
    """Return at most :data:`MODES` modes of a belief, each with a weight of at least :data:`LIKELY`. Modes with
    neighbouring poses are merged: the result has the pose of the first and the sum of the weights."""
    places: list[Mode] = []
    for mode in belief.modes:
        if not np.all(np.isfinite(mode.pose)):
            continue
        error = [se2.between(place.pose, mode.pose) for place in places]
        near = [i for i, e in enumerate(error) if math.hypot(e[0], e[1]) < NEXT and abs(e[2]) < NEXT_HEADING]
        if near:
            merged = places[near[0]]
            places[near[0]] = Mode(merged.weight + mode.weight, merged.pose, merged.covariance)
        else:
            places.append(mode)
    return tuple(place for place in places[:MODES] if place.weight >= LIKELY)


def _sampled(belief: Belief, space: FreeSpace, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return particles (M, 3) and weights (M,) of a belief. If the belief has no particles, they are drawn from its
    modes. If it has no modes either, they are drawn from free space."""
    if belief.particles is not None and belief.weights is not None and len(belief.particles):
        return belief.particles, belief.weights
    even = np.full(SAMPLES, 1.0 / SAMPLES)
    modes = [m for m in belief.modes if np.all(np.isfinite(m.covariance))]
    if not modes:
        rows = rng.integers(len(space.centres), size=SAMPLES)
        return np.column_stack((space.centres[rows], rng.uniform(-math.pi, math.pi, SAMPLES))), even
    shares = np.array([m.weight for m in modes])
    counts = rng.multinomial(SAMPLES, shares / shares.sum())
    drawn = [rng.multivariate_normal(m.pose, m.covariance, n) for m, n in zip(modes, counts, strict=True)]
    return np.concatenate(drawn), even
