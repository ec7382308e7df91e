"""The particles of ActiveMCL."""

import math
from dataclasses import replace

import numpy as np

from factorgraph_loc import IncrementOdometry, Tick
from factorgraph_loc.fusion.population import ELSEWHERE, FRESH
from factorgraph_loc.maps.free_space import free_space
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.planning.active_mcl import ActiveMcl, LengthsSeen
from factorgraph_loc.planning.robot import SimulatedRobot
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import make_world
from factors import se2


def made(seed: int = 0, name: str = "office"):
    simulation = preset(name)
    world = make_world(simulation.world, np.random.default_rng(seed))
    space = free_space(world, 0.35)
    setup = Setup(simulation.rig, world, ("odometry", "rfid"), np.random.default_rng((seed, 1)))
    rng = np.random.default_rng((seed, 2))
    start = np.array((*space.centres[rng.integers(len(space.centres))], rng.uniform(-math.pi, math.pi)))
    robot = SimulatedRobot(world, space, simulation, start, ActiveSettings(), rng)
    return ActiveMcl(setup, 2000, space), robot, space


def test_particles_begin_evenly_over_free_space_and_headings():
    _, _, space = made()
    poses = space.drawn(np.random.default_rng(0), 20_000)
    assert poses.shape == (20_000, 3)
    assert (space.cells(poses[:, :2]) >= 0).all()
    # 20,000 in 20 stretches and 8 directions: 1,000 and 2,500 each, were they drawn at random within 92 and 140 (3 sigma)
    number = np.bincount((space.cells(poses[:, :2]) * 20) // len(space.centres), minlength=20)
    assert np.abs(number - 1000).max() <= 6
    headings = np.bincount(((poses[:, 2] + math.pi) * 4.0 / math.pi).astype(int) % 8, minlength=8)
    assert np.abs(headings - 2500).max() <= 6


def test_stated_errors_fit_the_real_ones():
    """Squared errors over covariances of 6 robots that stand still: the mean of 6 chi-squares of 3 degrees of freedom is below 9
    in all but 2 of 100,000 cases; a third more is left to the few particles."""
    values = []
    for seed in range(6):
        estimator, robot, _ = made(seed)
        for m in (*robot.begin(), *robot.wait(3.0)):
            estimator.process(m)
        estimate = estimator.estimate()
        error = estimate.pose - robot.pose
        error[2] = se2.wrap_scalar(float(error[2]))
        values.append(error @ np.linalg.solve(estimate.covariance, error))
    assert np.mean(values) < 12.0
    assert np.median(values) < 6.0


class Blank:
    """An observation that says nothing."""

    found, work, things = 0, 1, frozenset()

    def log_likelihood(self, poses, values):
        return np.zeros(len(poses))


def test_particles_that_run_into_walls_lose_their_weight():
    estimator, _, space = made()
    population, motion = estimator._search._population, estimator._motion
    for k in range(21):
        motion.add(IncrementOdometry(0.1 * k, 0.1 * min(k, 1), 0.0, 0.0))
        population.add(motion.state(0.1 * k), Blank())
        population.advance()
    poses, weights = population.particles
    inside = space.cells(poses[:, :2]) >= 0
    assert 0.1 < inside.mean() < 0.9
    assert weights[inside].sum() > 0.9


def test_trajectory_is_what_it_said():
    estimator, robot, _ = made()
    for m in (*robot.begin(), *robot.wait(1.0)):
        estimator.process(m)
    estimator.process(Tick(1.0))
    said = estimator.estimate()
    last = estimator.trajectory()
    assert last.t[-1] == 1.0
    assert np.allclose(last.poses[-1], said.pose)
    assert np.allclose(last.covariances[-1], said.covariance)


def test_a_corridor_tells_the_heading_and_leaves_both_its_directions():
    """In the middle of an arm of the H, 9 m from its end, only the direction of the corridor is told. Of 20,000 particles, thinned
    by one look after the other, both directions keep a share: a half each within .4, which they miss by luck in few of 100."""
    estimator, robot, _ = made(name="symmetric")
    robot.pose = np.array((1.5, 7.0, math.pi / 2.0))
    population, now = estimator._search._population, estimator._motion.state(0.0)
    for _ in range(3):
        population.add(now, LengthsSeen(robot.proximity, robot.read_proximity()))
        population.advance()
    poses, weights = population.particles
    # along some corridor: those across are in the crossbar, where the robot would look along x
    in_arm = (poses[:, 0] < 3.0) | (poses[:, 0] > 27.0)
    aligned = np.abs(np.sin(poses[:, 2] - np.where(in_arm, math.pi / 2.0, 0.0))) < 0.3
    assert weights[aligned].sum() > 0.95
    up = in_arm & (np.sin(poses[:, 2]) > 0.9)
    down = in_arm & (np.sin(poses[:, 2]) < -0.9)
    assert 0.1 < weights[up].sum() / (weights[up].sum() + weights[down].sum()) < 0.9


def test_what_is_seen_before_the_first_scan_is_left():
    estimator, robot, _ = made()
    estimator.see(robot.proximity, robot.read_proximity())
    assert estimator.belief().particles is None


def test_particles_that_have_lost_the_robot_find_it_again_where_tags_are_read():
    """All particles but those that are drawn anywhere are at the other end of the building."""
    estimator, robot, space = made()
    for m in (*robot.begin(), *robot.wait(2.0)):
        estimator.process(m)
    far = space.centres[np.argmax(np.hypot(*(space.centres - robot.pose[:2]).T))]
    population = estimator._search._population
    population.advance()
    cloud = population._cloud
    poses = np.concatenate((np.tile((*far, 0.0), (len(cloud.poses) - FRESH, 1)), space.drawn(robot._noise, FRESH)))
    log_weights = np.full(len(poses), -np.log(len(poses)))
    log_weights[-FRESH:] = math.log(ELSEWHERE / FRESH)
    population._cloud, population._hypotheses = replace(cloud, poses=poses, log_weights=log_weights), None
    for m in robot.wait(3.0):
        estimator.process(m)
    assert np.hypot(*(estimator.estimate().pose - robot.pose)[:2]) < 0.5
