"""Time of a planning step, and the loss if fewer particles are used. One process at a time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from benchmarking.report import Options, Report

from active_benchmark.runs import SETTINGS, WORLDS
from factorgraph_loc.maps.free_space import FreeSpace, free_space
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.planning.active_mcl import ActiveMcl, ActiveMclSettings
from factorgraph_loc.planning.information import SCANS, expected_gain, has_several_modes
from factorgraph_loc.planning.paths import Path, primitives
from factorgraph_loc.planning.robot import SimulatedRobot
from factorgraph_loc.planning.sensors import Sensors
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import make_world

SEEDS = 10  # beliefs of each world
FIRST = 2000  # first seed, not used by other sections
SAMPLES = (16, 32, 64, 128, 256, 512)
BEST = 1024  # particles and scans of the reference that others are compared with
REPEATS = 5
DRIVEN = 2.0  # m driven before the belief is taken
CANDIDATES = 100


@dataclass(frozen=True)
class Outcome:
    """``modes``: whether the belief had several; by size ``ms`` (REPEATS,) of a step, and ``lost`` (REPEATS,) [nats]: the
    difference between the expected gains of the chosen path and of the best, with :data:`BEST` particles. ``best``: the latter.
    """

    modes: bool
    ms: dict[int, np.ndarray]
    lost: dict[int, np.ndarray]
    best: float


@dataclass(frozen=True)
class Belief:
    """Particles (M, 3) with weights (M,), the tags, and the walls."""

    particles: np.ndarray
    weights: np.ndarray
    sensors: Sensors
    space: FreeSpace


def section(options: Options) -> Report:
    report = Report("samples", options)
    jobs = [(world, FIRST + i) for world in WORLDS for i in range(options.count(SEEDS))]
    found = report.collect(tried, jobs, [f"{world}, seed {seed}" for world, seed in jobs], workers=1)
    outcomes = list(found.values())
    if not outcomes:
        return report
    several = sum(one.modes for one in outcomes)
    report.say(
        f"{CANDIDATES} candidates of up to {SETTINGS.policy.horizon:g} m, from beliefs of {SETTINGS.particles} particles after "
        f"{DRIVEN:g} m in {', '.join(WORLDS)}: {len(outcomes)} of them, {several} with several modes. *Step*: processor time, "
        f"median over the beliefs of the fastest of {REPEATS}, and the slowest of these. *Lost*: how much less the chosen path "
        f"tells than the best one, by {BEST} particles and as many scans; *of the best*: as a share of what the best tells"
    )
    rows = []
    for size in SAMPLES:
        ms = np.array([one.ms[size].min() for one in outcomes])
        lost = np.array([one.lost[size].mean() for one in outcomes])
        share = lost.sum() / sum(one.best for one in outcomes)
        scans = min(size, SCANS)
        rows.append(
            (
                f"{size}" + (" (default)" if size == SETTINGS.policy.samples else ""),
                str(scans),
                f"{np.median(ms):.0f}",
                f"{ms.max():.0f}",
                f"{lost.mean():.3f}",
                f"{100 * share:.1f} %",
            )
        )
    report.table(("particles", "scans", "step [ms]", "slowest [ms]", "lost [nats]", "of the best"), rows)
    single = [
        (*jobs[i], one.modes, size, one.ms[size].min(), one.lost[size].mean(), one.best)
        for i, one in found.items()
        for size in SAMPLES
    ]
    report.figures("steps", ("world", "seed", "several_modes", "samples", "ms", "lost", "best"), single)
    return report


def tried(job: tuple[str, int]) -> Outcome:
    """All sizes on one belief; jobs can be sent to other processes."""
    belief = belief_of(*job)
    horizon = SETTINGS.policy.horizon
    paths = [*primitives(horizon), *primitives(2.0 / 3.0 * horizon)][:CANDIDATES]
    truth = gains(belief, paths, BEST, BEST, 0)
    ms: dict[int, np.ndarray] = {}
    lost: dict[int, np.ndarray] = {}
    for size in SAMPLES:
        gains(belief, paths[:2], size, SCANS, 0)  # compiled by now
        times, chosen = [], []
        for repeat in range(REPEATS):
            started = time.process_time()
            chosen.append(int(np.argmax(gains(belief, paths, size, SCANS, 1 + repeat))))
            times.append(1e3 * (time.process_time() - started))
        ms[size], lost[size] = np.array(times), truth.max() - truth[chosen]
    return Outcome(has_several_modes(belief.particles, belief.weights), ms, lost, float(truth.max()))


def gains(belief: Belief, paths: list[Path], samples: int, scans: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng((seed, samples))
    given = (belief.sensors, belief.particles, belief.weights, paths, rng)
    return expected_gain(*given, dims=SETTINGS.policy.dimensions, space=belief.space, samples=samples, scans=scans)


def belief_of(name: str, seed: int) -> Belief:
    """The filter's belief after a robot with an unknown start has driven :data:`DRIVEN` straight on."""
    simulation = preset(name)
    rng = np.random.default_rng(seed)
    world = make_world(simulation.world, rng)
    space = free_space(world, SETTINGS.clearance)
    start = np.array((*space.centres[rng.integers(len(space.centres))], rng.uniform(-np.pi, np.pi)))
    robot = SimulatedRobot(world, space, simulation, start, SETTINGS, rng)
    setup = Setup(simulation.rig, world, ("odometry", "rfid"), rng)
    particles = ActiveMcl(setup, ActiveMclSettings(particles=SETTINGS.particles), space)
    straight = primitives(DRIVEN)
    free = robot.free_ahead(straight)
    reports = [*robot.begin(), *robot.drive(straight[int(np.argmax(free))].poses, DRIVEN)]
    for one in reports:
        particles.process(one)
    found = particles.belief()
    assert found.particles is not None, "a particle filter has particles"
    assert found.weights is not None, "and their weights"
    assert simulation.rig.rfid is not None, "the settings have been checked"
    sensors = Sensors.of(world, simulation.rig, simulation, only=robot.sensors)
    return Belief(found.particles, found.weights, sensors, space)
