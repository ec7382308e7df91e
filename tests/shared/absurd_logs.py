"""Short logs with faults, as broken sensors, wrong maps and wrong settings make them, and what must hold of runs on them."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from changed_logs import rows, with_rig, with_stream
from drives import even_noise

import factorgraph_loc as fgloc
from factorgraph_loc import BearingRangeStream, IncrementStream, InputError, Landmark, Log, RunFailedError, StartPose
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.measurement import Stream
from factors import se2

SECONDS = 4.0
Fault = Callable[[Log, np.random.Generator], Log]
FAULTS: dict[str, Fault] = {}


@lru_cache
def whole() -> Log:
    """A short drive through an office with tags and landmarks, all of which are seen all the time."""
    log = fgloc.simulate("office", 3, changes={"drive": {"duration": SECONDS}, "world": {"tags": 12, "landmarks": 6}})
    t = np.repeat(np.arange(0.23, SECONDS, 0.5), len(log.world.landmarks))
    names = list(log.world.landmarks) * (len(t) // len(log.world.landmarks))
    places = np.array([(log.world.landmarks[name].x, log.world.landmarks[name].y) for name in names])
    poses, rng = log.reference.at(t), np.random.default_rng(0)
    away = places - poses[:, :2]
    distance = np.hypot(*away.T) + 0.05 * rng.standard_normal(len(t))
    bearing = np.arctan2(away[:, 1], away[:, 0]) - poses[:, 2] + 0.02 * rng.standard_normal(len(t))
    seen = BearingRangeStream(t, names, np.maximum(distance, 0.01), se2.wrap(bearing))
    return replace(log, streams={**log.streams, "bearing_range": seen})


def in_order(log: Log) -> list[tuple[str, Stream]]:
    """The streams, in an order of which random draws can be sure."""
    return [(name, log.streams[name]) for name in ("odometry", "rfid", "bearing_range")]


def fault(function: Fault) -> Fault:
    """A fault by the name of its function."""
    FAULTS[function.__name__] = function
    return function


def verdict(log: Log, estimator: str, settings=None, sensors=None, prior=None, seed=0) -> str:
    """What became of a run: ``ok``, ``refused``, or the line of the RunFailedError that ended it. AssertionError where a result
    cannot be."""
    try:
        result = run(log, RunConfig(estimator, settings or {}, sensors, prior, seed))
    except InputError:
        return "refused"
    except RunFailedError as error:
        line = str(error)
        assert "\n" not in line
        assert len(line) < 300
        return line
    told = np.array([status != "unlocalized" for status in result.status], dtype=bool)
    require_sound(result.poses[told], result.covariances[told])
    require_sound(result.final.poses, result.final.covariances)
    for name, value in score(result, log).items():
        assert not isinstance(value, float) or math.isfinite(value), f"{name} is {value}"
    return "ok"


def require_sound(poses, covariances) -> None:
    """Finite poses (N, 3), and covariances (N, 3, 3) that are symmetric and positive, whatever their units."""
    assert np.all(np.isfinite(poses))
    assert np.all(np.isfinite(covariances))
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    assert np.all(variances > 0.0)
    sigmas = np.sqrt(variances)
    shares = covariances / sigmas[:, :, None] / sigmas[:, None, :]
    assert np.abs(shares - shares.transpose(0, 2, 1)).max(initial=0.0) < 2e-6
    np.linalg.cholesky((shares + shares.transpose(0, 2, 1)) / 2.0)


def with_landmarks(log: Log, place: Callable[[Landmark], tuple[float, float]]) -> Log:
    moved = {name: Landmark(x=float((p := place(m))[0]), y=float(p[1])) for name, m in log.world.landmarks.items()}
    return replace(log, world=log.world.model_copy(update={"landmarks": moved}))


def _glitch(log: Log, rng: np.random.Generator, column: str, size: float) -> Log:
    values = getattr(log.streams["odometry"], column).copy()
    values[rng.integers(1, len(values))] = size * rng.choice((-1.0, 1.0))
    return with_stream(log, "odometry", **{column: values})


@fault
def glitch_within_bounds(log, rng):
    return _glitch(log, rng, rng.choice(("dx", "dy")), 1e3)


@fault
def glitch_beyond_bounds(log, rng):
    return _glitch(log, rng, rng.choice(("dx", "dy")), 10.0 ** rng.integers(4, 13))


@fault
def glitch_of_a_turn(log, rng):
    return _glitch(log, rng, "dtheta", 100.0)


@fault
def many_glitches(log, rng):
    for _ in range(10):
        log = _glitch(log, rng, rng.choice(("dx", "dy", "dtheta")), rng.choice((1.0, 10.0, 100.0)))
    return log


@fault
def repeated_rows(log, rng):
    for name, stream in in_order(log):
        log = rows(log, name, np.sort(rng.integers(0, len(stream.t), 2 * len(stream.t))))
    return log


@fault
def missing_rows(log, rng):
    for name, stream in in_order(log):
        log = rows(log, name, np.flatnonzero(rng.random(len(stream.t)) < 0.4))
    return log


@fault
def coincident_landmarks(log, rng):
    place = rng.choice([(m.x, m.y) for m in log.world.landmarks.values()])
    return with_landmarks(log, lambda _: place)


@fault
def landmarks_at_the_robot(log, rng):
    seen = log.streams["bearing_range"]
    place = log.reference.at(seen.t)[rng.integers(len(seen.t)), :2]
    log = with_landmarks(log, lambda _: place)
    return with_stream(log, "bearing_range", range=np.full(len(seen.t), 1e-3)) if rng.random() < 0.5 else log


@fault
def landmarks_at_the_start(log, _):
    log = with_landmarks(log, lambda _: log.start.pose[:2])
    still = log.streams["odometry"]
    return with_stream(log, "odometry", **{k: np.zeros(len(still.t)) for k in ("dx", "dy", "dtheta")})


@fault
def tiny_sigmas(log, _):
    log = with_rig(log, "bearing_range", range_sigma=1e-4, range_sigma_relative=0.0, bearing_sigma=1e-5)
    return replace(log, start=StartPose(log.start.t, log.start.pose, np.full(3, 1e-6)))


@fault
def huge_sigmas(log, _):
    log = with_rig(log, "bearing_range", range_sigma=10.0, bearing_sigma=0.5)
    return replace(log, start=StartPose(log.start.t, log.start.pose, np.full(3, 1e3)))


@fault
def sharp_sight_of_a_vague_start(log, _):
    log = with_rig(log, "bearing_range", range_sigma=1e-4, range_sigma_relative=0.0, bearing_sigma=1e-5, robust=100.0)
    return replace(log, start=StartPose(log.start.t, log.start.pose, np.array((1e3, 1e3, 1e3))))


@fault
def wrong_map(log, rng):
    places = rng.permutation([(m.x, m.y) for m in log.world.landmarks.values()]).tolist()
    return with_landmarks(log, lambda _: places.pop())


@fault
def far_map(log, rng):
    off = 10.0 ** rng.uniform(1.0, 6.9, 2) * rng.choice((-1.0, 1.0), 2)
    return with_landmarks(log, lambda m: (m.x + off[0], m.y + off[1]))


@fault
def far_start(log, rng):
    pose = np.append(rng.uniform(-1e7, 1e7, 2), rng.uniform(-3.0, 3.0))
    return replace(log, start=StartPose(log.start.t, pose, log.start.sigmas))


@fault
def clock_jumps(log, rng):
    name = rng.choice(["odometry", "bearing_range", "rfid"])
    t = log.streams[name].t
    where = rng.integers(0, max(1, len(t)))
    later = 10.0 ** rng.uniform(-1.0, 6.0)
    return with_stream(log, name, t=t + later * (np.arange(len(t)) >= where))


@fault
def clock_jumps_back(log, rng):
    name = rng.choice(["bearing_range", "rfid"])
    t = log.streams[name].t
    return with_stream(log, name, t=t - rng.uniform(0.1, 3.0) * (np.arange(len(t)) >= len(t) // 2))


@fault
def clocks_years_apart(log, rng):
    name = rng.choice(["odometry", "bearing_range", "rfid"])
    return with_stream(log, name, t=log.streams[name].t + 1.7e9)


@fault
def tiny_ranges(log, _):
    return with_stream(log, "bearing_range", range=np.full(len(log.streams["bearing_range"].t), 1e-3))


@fault
def huge_ranges(log, rng):
    return with_stream(log, "bearing_range", range=log.streams["bearing_range"].range * 10.0 ** rng.uniform(1.0, 3.0))


@fault
def random_sightings(log, rng):
    n = len(log.streams["bearing_range"].t)
    return with_stream(
        log, "bearing_range", range=10.0 ** rng.uniform(-3.0, 5.0, n), bearing=rng.uniform(-np.pi, np.pi, n)
    )


@fault
def ranges_or_bearings_alone(log, rng):
    seen = log.streams["bearing_range"]
    lacks = rng.random((2, len(seen.t))) < rng.choice((0.5, 0.9, 1.0))
    return with_stream(
        log,
        "bearing_range",
        range=np.where(lacks[0], np.nan, seen.range),
        bearing=np.where(lacks[1], np.nan, seen.bearing),
    )


@fault
def increments_of_no_duration(log, rng):
    t = log.streams["odometry"].t
    return with_stream(log, "odometry", t=np.sort(t[rng.integers(0, len(t), len(t))]))


@fault
def random_increments(log, rng):
    n = len(log.streams["odometry"].t)
    moves = rng.standard_normal((3, n)) * 10.0 ** rng.uniform(-3.0, 3.0)
    ways = np.clip(moves, -1000.0, 1000.0)
    return with_stream(log, "odometry", dx=ways[0], dy=ways[1], dtheta=np.clip(moves[2], -100.0, 100.0))


@fault
def one_row_each(log, rng):
    for name, stream in log.streams.items():
        log = rows(log, name, [int(rng.integers(len(stream.t)))])
    return log


@fault
def one_row_in_all(log, rng):
    name = rng.choice(["odometry", "bearing_range", "rfid"])
    return rows(replace(log, streams={k: s for k, s in log.streams.items() if k == name}), name, [0])


@fault
def odometry_alone(log, _):
    for name in ("bearing_range", "rfid"):
        log = rows(log, name, [])
    return log


@fault
def no_odometry(log, rng):
    return rows(log, "odometry", [] if rng.random() < 0.5 else [0])


@fault
def no_noise_of_odometry(log, rng):
    log = with_rig(log, "odometry", noise=even_noise())
    still = IncrementStream(log.streams["odometry"].t, *np.zeros((3, len(log.streams["odometry"].t))))
    return replace(log, streams={**log.streams, "odometry": still}) if rng.random() < 0.5 else log


@fault
def all_tags_read_everywhere(log, rng):
    scans, tags = log.streams["rfid"], list(log.world.tags)
    return with_stream(log, "rfid", epc=[tags[int(i)] for i in rng.integers(0, len(tags), len(scans.t))])


@fault
def no_tag_read(log, _):
    return with_stream(log, "rfid", epc=[""] * len(log.streams["rfid"].t))


@fault
def uncertain_constants(log, _):
    unsure = log.rig.bearing_range.uncertainty.model_copy(
        update={"x": 10.0, "y": 10.0, "bearing_bias": 3.0, "range_scale": 0.5, "time_offset": 1.0}
    )
    return with_rig(log, "bearing_range", uncertainty=unsure)
