"""Random sequences of calls of ``Localizer``, and the invariants of each call.

Sequences are drawn from a :class:`Draw`: a numpy generator here, hypothesis in the tests. Only ``FglocError`` may be raised;
estimates are finite with positive definite covariances; queries and refused calls change nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, Protocol

import numpy as np
from numpy.random import Generator

import factorgraph_loc as fgloc
from factorgraph_loc.errors import FglocError
from factorgraph_loc.model.log import Log
from fuzzing.results import CHECKS, check_estimate, check_trajectory
from fuzzing.seeds import drive
from fuzzing.verdicts import WrongResultError, fault_of

ESTIMATORS: dict[str, tuple[dict[str, Any], ...]] = {
    "dead_reckoning": ({},),
    "ekf": ({}, {"landmarks": "unknown"}, {"iterations": 3}, {"max_delay": 0.0}),
    "particle_filter": ({"particles": 30}, {"particles": 50, "kld": True, "min_particles": 10}),
    "switching": ({"particles": 30},),
    "smoother": ({}, {"lag": 1.0}, {"lag": None}, {"landmarks": "unknown"}, {"landmarks": "uncertain", "lag": 3.0}),
    "batch": ({}, {"landmarks": "unknown"}),
    "monoslam": ({}, {"landmarks": "unknown"}, {"planar": False}),
    "space_batch": ({}, {"planar": False}),
    "space_smoother": ({}, {"lag": 0.5}),
}
CHOSEN = ("ekf", "particle_filter", "smoother", *ESTIMATORS)
SENSORS = ("odometry", "imu", "rfid", "bearing_range", "sightings", "rssi", "phase", "camera")
ABSURD: tuple[Any, ...] = (
    *(
        math.nan,
        math.inf,
        -math.inf,
        1e308,
        -1e308,
        1e300,
        1e12,
        1e6,
        -1e6,
        1e3,
        100.0,
        -1.0,
        0.0,
        -0.0,
        1e-3,
        1e-9,
        1e-300,
        5e-324,
    ),
    *(10**400, 2**63, True, None, "x", "1.0", b"1", [1.0], [], {}, 1j, Decimal("1.5"), np.float32(1.0), np.array(1.0)),
    *(np.array([1.0, 2.0]), np.datetime64("2026-01-01"), np.array(None), np.ma.masked, object, np.full((2, 2), np.nan)),
)


class Draw(Protocol):
    """A source of random choices."""

    def integer(self, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""

    def number(self, low: float, high: float) -> float:
        """A finite number from ``low`` to ``high``."""


class RandomDraw:
    """Choices of a numpy generator."""

    def __init__(self, rng: Generator) -> None:
        self._rng = rng

    def integer(self, low: int, high: int) -> int:
        return int(self._rng.integers(low, high + 1))

    def number(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))


@dataclass(frozen=True)
class Call:
    """A method of ``Localizer`` and its arguments."""

    method: str
    given: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Play:
    """An estimator and a sequence of calls; ``twice``: repeat without queries and refused calls."""

    estimator: str
    settings: dict[str, Any]
    history: float
    calls: tuple[Call, ...]
    twice: bool = False


@dataclass
class Played:
    """The last estimate, and the accepted calls that change something."""

    estimate: Any = None
    taken: list[Call] = field(default_factory=list)


@functools.cache
def log() -> Log:
    """Measurements of a robot in a small world."""
    return drive(4.0)


@functools.cache
def measured() -> tuple[Any, ...]:
    return tuple(log().measurements(("odometry", "imu", "rfid", "bearing_range", "sightings")))


def one_of(draw: Draw, items: Sequence[Any]) -> Any:
    return items[draw.integer(0, len(items) - 1)]


def sequence(draw: Draw, longest: int = 40) -> Play:
    """A sequence of calls, most of them meaningful."""
    estimator = one_of(draw, CHOSEN)
    calls: list[Call] = []
    start = log().start
    assert start is not None
    if draw.integer(0, 9) > 0:
        calls.append(Call("initialize", (start.pose, None, None)))
    clock = 0.0
    for _ in range(draw.integer(2, longest)):
        kind = draw.integer(0, 19)
        clock += one_of(draw, (0.0, 0.01, 0.05, 0.1, 0.1, 0.1, 0.3, 1.0, 2.0, -0.1, -0.4, -2.0))
        if kind < 6:  # like a real robot
            near = [m for m in measured() if clock - 0.15 <= m.t <= clock]
            calls += [Call("push", (m,)) for m in near]
        elif kind < 13:
            calls.append(Call("push", (_measurement(draw, clock),)))
        elif kind == 13:
            calls.append(_initialize(draw))
        elif kind == 14:
            calls.append(_reads(draw, clock))
        elif kind == 15:
            image = one_of(draw, (np.zeros((480, 640), np.uint8), np.zeros((2, 2)), None, "x", np.zeros((0, 0, 3))))
            calls.append(Call("push_image", (_time(draw, clock), image)))
        elif kind < 18:
            at = (
                one_of(draw, (None, clock, clock + 0.5, clock - 1.0, clock + 1e4, *ABSURD))
                if draw.integer(0, 1)
                else None
            )
            calls.append(Call("estimate", (at,)))
        else:
            calls.append(Call(one_of(draw, ("belief", "learnt", "trajectory", "diagnostics"))))
    return Play(
        estimator,
        one_of(draw, ESTIMATORS[estimator]),
        one_of(draw, (60.0, 1.0, 0.2)),
        tuple(calls),
        twice=draw.integer(0, 3) == 0,
    )


def _time(draw: Draw, clock: float) -> Any:
    return one_of(draw, (*[clock] * 12, 0, -1.0, clock + 3000.0, clock + 1e9, *ABSURD)) if draw.integer(0, 1) else clock


def _value(draw: Draw, usual: float) -> Any:
    """Mostly ``usual``, else another number, or absurd."""
    choice = draw.integer(0, 9)
    if choice < 6:
        return usual
    if choice < 8:
        return usual * 10.0 ** draw.integer(-12, 12)
    return one_of(draw, ABSURD) if choice == 8 else draw.number(-1e6, 1e6)


def _array(draw: Draw, usual: Sequence[float]) -> Any:
    choice = draw.integer(0, 19)
    if choice == 0:
        return one_of(draw, ABSURD)
    if choice == 1:
        return one_of(
            draw,
            ([*usual, 1.0], usual[:-1], np.array(usual)[None], np.array(usual, dtype=object), list(map(str, usual))),
        )
    values = [_value(draw, value) if choice < 8 else value for value in usual]
    return values if any(not isinstance(v, float) for v in values) else np.array(values)


def _names(draw: Draw, known: Sequence[str], count: int) -> Any:
    if draw.integer(0, 14) == 0:
        return one_of(
            draw, ((), "x", None, 5, [1, 2], ("a" * 5000,), ("\x00",) * count, ("\x1b[31m",), [known[0]] * count)
        )
    return tuple(one_of(draw, (*known, "stranger")) for _ in range(count))


def _measurement(draw: Draw, clock: float) -> Any:
    return one_of(draw, MAKERS)(draw, _time(draw, clock))


def _velocity(draw: Draw, t: Any) -> Any:
    return fgloc.VelocityOdometry(t, _value(draw, 0.5), _value(draw, 0.1))


def _increment(draw: Draw, t: Any) -> Any:
    return fgloc.IncrementOdometry(t, _value(draw, 0.05), _value(draw, 0.0), _value(draw, 0.01))


def _yaw_rate(draw: Draw, t: Any) -> Any:
    return fgloc.YawRate(t, _value(draw, 0.1))


def _twist(draw: Draw, t: Any) -> Any:
    return fgloc.Twist(t, _array(draw, (0.5, 0.0, 0.0)), _array(draw, (0.0, 0.0, 0.1)))


def _landmarks(draw: Draw, t: Any) -> Any:
    count = _count(draw)
    names = _names(draw, sorted(log().world.landmarks), count)
    return fgloc.BearingRange(t, names, _array(draw, (2.0,) * count), _array(draw, (0.3,) * count))


def _points(draw: Draw, t: Any) -> Any:
    count, points = _count(draw), log().world.points
    assert points is not None
    return fgloc.PixelSightings(t, _names(draw, list(points.names), count), _pixels(draw, count))


def _scan(draw: Draw, t: Any) -> Any:
    count = _count(draw)
    antennas = _names(draw, ("1", "2", "3"), 2)
    tags = _names(draw, sorted(log().world.tags), count)
    usual = np.zeros(count, np.int64)
    place = one_of(draw, (usual, usual, usual, usual + 5, np.zeros(count), None, [0] * count, usual - 1))
    more = [_array(draw, (value,) * count) for value in (0.0, -60.0, 1.0, 920e6)]
    return fgloc.RfidScan(t, antennas, place, tags, *more)


def _frame(draw: Draw, t: Any) -> Any:
    count = _count(draw)
    usual = np.full((count, 2), 100.0), np.zeros((count, 64), np.float32), np.arange(count)
    pixels = one_of(draw, (usual[0], usual[0], 5, np.zeros((count, 3)), None, [[1.0, 2.0]] * count, "ab"))
    others = (np.zeros((count, 3)), 5, None, np.zeros((count + 1, 8)), np.full((count, 64), np.nan))
    looks = one_of(draw, (usual[1], usual[1], *others))
    tracks = one_of(draw, (usual[2], usual[2], 5, None, np.zeros(count), np.arange(count + 1)))
    feature = one_of(draw, ("colour", "colour", "orb", "x", 5, None))
    return fgloc.CameraFrame(t, feature, pixels, _array(draw, (3.0,) * count), looks, tracks)


def _nothing(draw: Draw, t: Any) -> Any:
    return one_of(draw, (None, 5, "x", fgloc.Tick(t), object(), fgloc.VelocityOdometry, [], measured()[0]))


def _count(draw: Draw) -> int:
    return int(one_of(draw, (1, 1, 2, 3, 0)))


MAKERS = (
    _velocity,
    _increment,
    _increment,
    _yaw_rate,
    _twist,
    _landmarks,
    _landmarks,
    _points,
    _scan,
    _frame,
    _nothing,
)


def _pixels(draw: Draw, count: int) -> Any:
    usual = np.full((count, 2), 200.0)
    others: tuple[Any, ...] = (
        np.full((count, 2), 1e300),
        np.full((count, 2), np.nan),
        -usual,
        usual[:, :1],
        None,
        [],
        "x",
    )
    return one_of(draw, (usual, usual + draw.number(0.0, 100.0), usual * draw.number(0.0, 2.0), *others))


def _initialize(draw: Draw) -> Call:
    poses = (
        (10.0, 6.0, 0.5),
        (10.0, 6.0, math.nan),
        None,
        [1e308, 0, 0],
        (1e12, 0, 0),
        (0, 0),
        "x",
        (math.inf, 0, 0),
        (0, 0, 1e9),
    )
    spreads = (
        None,
        np.eye(3) * 0.01,
        np.eye(2),
        np.zeros((3, 3)),
        -np.eye(3),
        np.eye(3) * 1e-18,
        np.eye(3) * 1e18,
        np.ones((3, 3)),
        5,
        "x",
    )
    return Call(
        "initialize",
        (one_of(draw, poses), one_of(draw, (None, *spreads)), one_of(draw, (None, None, 0.0, 1.0, 1e9, *ABSURD))),
    )


def _reads(draw: Draw, clock: float) -> Call:
    t = _time(draw, clock)
    epcs = [*sorted(log().world.tags), "stranger", "", "\x00", 5]
    reads = [
        fgloc.RfidRead(
            one_of(draw, ("1", "2", "9")),
            one_of(draw, epcs),
            one_of(draw, (None, clock, math.nan, "x", 1e300)),
            _value(draw, -60.0),
        )
        for _ in range(draw.integer(0, 3))
    ]
    return Call(
        "push_reads",
        (t, one_of(draw, (("1", "2"), ("1",), (), "1", None, ("1", "1"))), one_of(draw, (reads, reads, (), None, 5))),
    )


def play(sequence: Play) -> None:
    """Execute all calls. Raises WrongResultError, or any exception that is not an ``FglocError``."""
    first = _play(sequence, sequence.calls, ask=True)
    if sequence.twice:
        again = _play(sequence, first.taken, ask=False)
        if not _same(first.estimate, again.estimate):
            raise WrongResultError(f"{sequence.estimator}: what was asked or refused has changed the estimate")


def play_random(rng: Generator) -> None:
    play(sequence(RandomDraw(rng)))


def _play(sequence: Play, calls: Sequence[Call], *, ask: bool) -> Played:
    localizer = fgloc.Localizer(
        log().rig,
        log().world,
        sequence.estimator,
        settings=sequence.settings,
        history=sequence.history,
        sensors=SENSORS,
    )
    out, lost = Played(), False
    for call in calls:
        changes = call.method.startswith(("push", "initialize"))
        if not changes and not ask:
            continue
        try:
            found = getattr(localizer, call.method)(*call.given)
        except FglocError as error:
            if fault := fault_of(str(error)):
                raise WrongResultError(f"{call.method}: {fault}: {str(error)[:200]!r}") from error
            lost = lost or error.exit_code == 1
            if error.exit_code == 1 and changes:
                out.taken.append(call)
            continue
        if changes:
            out.taken.append(call)
            lost = lost and call.method != "initialize"
        else:
            CHECKS[call.method](found)
    try:
        out.estimate = localizer.estimate()
        check_estimate(out.estimate)
        check_trajectory(localizer.trajectory())
    except FglocError as error:
        if fault := fault_of(str(error)):
            raise WrongResultError(f"{fault}: {str(error)[:200]!r}") from error
    return out


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    same = np.array_equal(one.pose, other.pose, equal_nan=True) and one.status == other.status
    return bool(same and np.array_equal(one.covariance, other.covariance, equal_nan=True))
