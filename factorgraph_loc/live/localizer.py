"""Online localization: measurements are pushed as they arrive, and estimates are pulled when they are needed."""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_loc.errors import InputError, RunFailedError, bad_field
from factorgraph_loc.files.columns import POSES
from factorgraph_loc.files.models import FARTHEST
from factorgraph_loc.files.values import numbers, seconds_of
from factorgraph_loc.fusion import registry
from factorgraph_loc.fusion.base import Estimator, ForgettingEstimator, finds_heading
from factorgraph_loc.fusion.guarded import Guard, sound, sound_belief, sound_trajectory
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import HEADING_SIGMA, POSITION_SIGMA, Belief, Learnt, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick, channel_of, named
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.scoring import Ticks
from factorgraph_loc.model.setup import MapFrame
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.interfaces import lacking_section
from factorgraph_loc.sensors.registry import channels, sensor_of
from factorgraph_loc.sensors.tables import Intake, checked
from factorgraph_loc.text import quoted

LAG = 10.0  # s: default lag of the smoother
HISTORY = 60.0  # s: default length of the past that is kept
TIDY_INTERVAL = 5.0  # s between removals of data older than ``history``, by the timestamps of measurements
ROWS_KEPT = 1000  # maximum number of rows in each list of diagnostics
AHEAD = 3600.0  # s: a timestamp that exceeds all others by more than this is from another clock


class Localizer:
    """An estimator for online use. Any number of threads may push measurements and pull estimates.

    ``rig``, ``world``: the robot and the map.
    ``estimator``: the name of the estimator. ``settings``: overrides of its default settings. The smoother has a fixed
    lag of 10 s by default. With ``lag = None`` it keeps the whole past.
    ``sensors``: names of the sensors to use, by default those in the rig. Measurements of other sensors are counted as
    ignored. ``history``: length of the past that :meth:`trajectory` returns [s], which limits the memory.
    ``seed``: the seed of the random generator.

    Call :meth:`initialize` first, and again to restart. Timestamps are seconds of any clock that all sensors share. The
    time offsets of the rig are added to them. A lock protects the estimator: a push waits while another measurement is
    processed. The same measurements in the same order give the same results. Queries do not change the results.

    Raises InputError if an argument is invalid.
    """

    def __init__(
        self,
        rig: Rig,
        world: World | None = None,
        estimator: str = "smoother",
        *,
        settings: Mapping[str, Any] | None = None,
        sensors: Sequence[str] | None = None,
        history: float = HISTORY,
        seed: int = 0,
    ) -> None:
        require_options(rig, world, settings, history, seed)
        self._rig, self._world, self._name = rig, world or World(), estimator
        default = {"lag": LAG} if estimator == "smoother" else {}
        self._settings = registry.settings_of(estimator, default | dict(settings or {}))
        self._sensors = usable_sensors(rig, sensors)
        setup = model_setup.Setup(rig, self._world, self._sensors, np.random.default_rng(seed))
        self._modalities = getattr(registry.estimator_type(estimator), "modalities", ())
        self._frame = MapFrame.of(setup, self._modalities, getattr(self._settings, "landmarks", "known"))
        self._offsets = {name: rig.time_offset(name) for name in self._sensors}  # s
        self._history, self._seed = history, seed
        self._lock = threading.Lock()
        self._begin_anew(None, None, Guard(estimator))

    def initialize(
        self, pose: ArrayLike | None = None, covariance: ArrayLike | None = None, t: float | None = None
    ) -> None:
        """Start or restart the estimator.

        ``pose`` (3,): x, y [m] and heading [rad] in the world frame. None starts at an unknown pose in the map. A NaN
        heading is unknown; the status is then not ``localized`` until measurements determine the heading.
        ``covariance`` (3, 3) of the pose, or (2, 2) of the position if the heading is NaN. The default has standard
        deviations of 0.05 m and 0.05 rad. ``t``: time of the pose [s], by default the time of the first measurement. Of
        the measurements before ``t``, only the last velocity of the odometry is used.

        Raises InputError if an argument is invalid or if the estimator does not support an unknown pose. Raises
        RunFailedError if the estimator cannot start at the pose. The previous state is kept in both cases.
        """
        start = None if pose is None else prior_of(pose, covariance, t)
        setup = model_setup.Setup(self._rig, self._world, self._sensors, np.random.default_rng(self._seed))
        guard = Guard(self._name)
        with guard:
            new = registry.create(self._name, setup, self._settings)
        if start is None and not getattr(new, "supports_unknown_start", False):
            raise InputError(f"{self._name} cannot start from an unknown pose with this rig and map: give a pose")
        if start is not None and not start.has_heading and not finds_heading(new):
            raise InputError(f"{self._name} cannot estimate an unknown heading with this rig and map: give a heading")
        if start is not None and not math.isnan(start.t):
            with guard.computing("the start", start.t):
                new.initialize(self._frame.prior(start))
        with self._lock:
            self._begin_anew(new, start, guard)

    def push(self, measurement: Measurement) -> None:
        """Process a measurement. Push measurements in order of arrival.

        A measurement may have an older timestamp than those before it. If it is older by at most ``max_delay``, a
        setting of the estimator, it is processed at its own time. Otherwise it is counted and dropped. Features of an
        image are detected in the calling thread while other measurements are processed.

        Raises InputError in these cases. The measurement is then dropped and nothing else changes.

        - A value is invalid, such as NaN.
        - :meth:`initialize` was not called.
        - A timestamp is an hour ahead of all others.
        - Increments of odometry go back in time.

        Raises RunFailedError if the estimator fails. Every call except :meth:`diagnostics` then raises this error until
        :meth:`initialize` is called. Unknown tags, antennas and landmarks are counted, see :meth:`diagnostics`.
        """
        own = checked(measurement)
        intake = self._intakes.get(own.sensor) if own.modality in self._modalities else None
        if intake is not None:
            own = intake.measured(own)
        with self._lock:
            self._take(own)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """Return the pose at the newest timestamp of all measurements, or predicted by odometry to a later time ``t`` [s].

        A prediction does not change the state of the estimator. Before the start, the status is ``unlocalized`` and the
        pose is NaN. Raises RunFailedError if the estimator has failed, if the estimate is not finite, or if its
        covariance is not positive. After the last two errors the localizer can still be used.
        """
        with self._lock:
            return self._estimate(t)

    def belief(self) -> Belief:
        """Return the distribution of the pose at the newest timestamp: Gaussian modes, and particles if there are any.

        Before the start it has no modes. Raises RunFailedError if the estimator has failed, or if a mode is not valid.
        """
        with self._lock:
            self._require_whole()
            if self._estimator is None or not self._is_under_way(self._newest):
                return Belief(())
            with self._guard.computing("the belief", self._newest):
                return copy.deepcopy(self._frame.belief(sound_belief(self._estimator.belief(self._newest))))

    def trajectory(self) -> Trajectory:
        """Return the smoothed poses at 10 Hz, for at least the last ``history`` seconds before the newest timestamp."""
        with self._lock:
            self._require_whole()
            if self._estimator is None or self._ticks is None or not self._ticks.count:
                return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
            with self._guard.computing("the trajectory"):
                return copy.deepcopy(self._frame.trajectory(sound_trajectory(self._estimator.trajectory())))

    def learnt(self) -> Learnt:
        """Return smoothed estimates other than poses: calibration constants of sensors, landmarks and map points."""
        with self._lock:
            self._require_whole()
            if self._estimator is None:
                return Learnt()
            with self._guard.computing("what was learnt"):
                return copy.deepcopy(self._estimator.learnt())

    def diagnostics(self) -> Diagnostics:
        """Return the counts of ignored, rejected and delayed measurements since the start, and recent statistics.

        A delayed measurement has an older timestamp than a previous one. The statistics are residuals and normalised
        innovations by sensor, and events such as a rebuilt graph.
        """
        with self._lock:
            return Diagnostics() if self._estimator is None else copy.deepcopy(self._estimator.diagnostics)

    def _begin_anew(self, estimator: Estimator | None, prior: PosePrior | None, guard: Guard) -> None:
        self._estimator = estimator
        self._guard = guard
        self._failure: RunFailedError | None = None  # the error after which the estimator is unusable
        self._prior = prior  # its time is NaN until the first measurement if no time was given
        # the times at which the estimator is updated start at the time of the prior, or at the first measurement
        self._ticks = None if prior is None or math.isnan(prior.t) else Ticks(prior.t)
        self._newest = self._tidied = -math.inf
        self._last: PoseEstimate | None = None  # the latest estimate, None after a new measurement
        known = channels()
        self._intakes: dict[str, Intake] = {
            name: load(known[name].intake)(self._rig, self._world)
            for name in self._sensors
            if name in known and known[name].intake
        }

    def _require_whole(self) -> None:
        if self._failure is not None:
            raise RunFailedError(str(self._failure)) from self._failure

    def _begun(self, what: str) -> Estimator:
        self._require_whole()
        if self._estimator is None:
            raise InputError(f"{what} came before initialize(): call initialize() first")
        return self._estimator

    def _take(self, m: Measurement) -> None:
        if (estimator := self._estimator) is None or self._failure is not None:
            estimator = self._begun(named(m))
        if (offset := self._offsets.get(channel_of(m))) is None:
            estimator.diagnostics.ignore(f"{channel_of(m)} is not among the sensors")
            return
        if offset:
            m = replace(m, t=m.t + offset)  # type: ignore[type-var]
        self._check_stamp(m)
        self._newest = max(self._newest, m.t)
        self._last = None
        try:
            self._feed(estimator, m)
        except BaseException as error:  # an interrupt also leaves the estimator in an undefined state
            if isinstance(error, RunFailedError):
                self._failure = error
            else:
                self._failure = RunFailedError(
                    f"{self._name}: unusable after {type(error).__name__}; call initialize() again"
                )
            raise
        if self._newest >= self._tidied + TIDY_INTERVAL:
            self._tidy(estimator)

    def _feed(self, estimator: Estimator, m: Measurement) -> None:
        if self._ticks is None:
            self._ticks = Ticks(m.t)
            if self._prior is not None:
                self._prior = replace(self._prior, t=m.t)
                with self._guard.computing("the start", m.t):
                    estimator.initialize(self._frame.prior(self._prior))
        # the estimator is updated after all measurements up to the time of the tick, as in a run on a log
        for t in self._ticks.advance(m.t):
            self._guard.process(estimator, Tick(t))
        if not m.is_motion and not self._is_under_way(m.t):
            estimator.diagnostics.ignore("before the start")
            return
        self._guard.process(estimator, m)

    def _check_stamp(self, m: Measurement) -> None:
        if m.t > self._newest + AHEAD and math.isfinite(self._newest):
            raise InputError(
                f"{named(m)}: is {m.t - self._newest:.0f} s ahead of all other timestamps, expected the same clock; "
                f"call initialize() after a pause"
            )
        if (intake := self._intakes.get(m.sensor)) is not None:
            intake.require(m)

    def _is_under_way(self, t: float) -> bool:
        """True if ``t`` [s] is finite and not before the time of the start pose."""
        return math.isfinite(t) and (self._prior is None or t >= self._prior.t)

    def _estimate(self, t: float | None) -> PoseEstimate:
        self._require_whole()
        at = self._newest if t is None else max(self._newest, seconds_of("estimate()", t))
        if self._last is not None and self._last.t == at:
            return _copied(self._last, at)
        if self._estimator is None or not math.isfinite(self._newest) or not self._is_under_way(at):
            return PoseEstimate(math.nan, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        if at > self._newest + AHEAD:
            raise InputError(
                f"t is {at:.3f} s, {at - self._newest:.0f} s ahead of all measurements, expected the same clock"
            )
        with self._guard.computing("the estimate", at):
            estimate = self._frame.estimate(sound(self._estimator.estimate(at)))
        # copied, because an estimator may reuse its arrays
        self._last = _copied(estimate, at)
        return _copied(estimate, at)

    def _tidy(self, estimator: Estimator) -> None:
        """Remove data older than ``history`` from the estimator, and shorten the lists of diagnostics."""
        self._tidied = self._newest
        if isinstance(estimator, ForgettingEstimator) and self._ticks is not None and self._ticks.count:
            estimator.forget(self._newest - self._history)
        estimator.diagnostics.keep_last(ROWS_KEPT)


def _copied(e: PoseEstimate, t: float) -> PoseEstimate:
    """Return a copy of the estimate ``e`` with copied arrays and the time ``t`` [s]."""
    return replace(e, t=t, pose=np.array(e.pose), covariance=np.array(e.covariance))


# bounds of the standard deviations of a start pose [m, m, rad]; a pose with larger ones is unknown
NARROWEST, WIDEST, WIDEST_TURN = 1e-6, 1e4, 100.0
RATIO = 1e14  # largest ratio of eigenvalues of a covariance, because a double has 16 digits


def require_options(rig: object, world: object, settings: object, history: object, seed: object) -> None:
    """Raise InputError if an argument has a type or value that :class:`Localizer` does not accept."""
    for name, value, kind in (
        ("rig", rig, Rig),
        ("world", world, World | None),
        ("settings", settings, Mapping | None),
    ):
        if not isinstance(value, kind):
            raise bad_field("Localizer()", name, value, f"a {getattr(kind, '__name__', kind)}")
    if isinstance(settings, Mapping) and (odd := [key for key in settings if not isinstance(key, str)]):
        raise bad_field("Localizer()", "settings", odd[0], "names of settings")
    if isinstance(history, bool) or not isinstance(history, (int, float, np.integer, np.floating)) or not history > 0.0:
        raise InputError(f"history is {quoted(history)}, expected more than 0 s")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**128:
        raise bad_field("Localizer()", "seed", seed, "a whole number from 0 to 2^128")


def usable_sensors(rig: Rig, asked: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the sensors in ``asked`` that the rig has settings of. None: all sensors of the rig.

    Raises InputError if a sensor is unknown.
    """
    if asked is None:
        asked = rig.sensors
    if isinstance(asked, str) or not isinstance(asked, Sequence):
        raise bad_field("Localizer()", "sensors", asked, "names of sensors")
    for name in asked:
        sensor_of(name if isinstance(name, str) else quoted(name))
    return tuple(name for name in rig.expanded(asked) if not lacking_section(rig, name))


def prior_of(pose: ArrayLike, covariance: ArrayLike | None, t: float | None) -> PosePrior:
    """Return the Gaussian prior of a start pose. ``pose`` (3,): x, y [m] and heading [rad], NaN for an unknown heading.

    ``covariance``: (3, 3), or (2, 2) if the heading is unknown; None for the default. ``t``: time [s], stored as NaN if
    None. Raises InputError if an argument is invalid.
    """
    mean = numbers("initialize()", "pose", pose)
    known = mean[: 2 if mean.shape == (3,) and np.isnan(mean[2]) else 3] if mean.shape == (3,) else mean
    if mean.shape != (3,) or any(POSES[n].outside(v) for n, v in zip(("x", "y", "heading"), known, strict=False)):
        expected = f"finite x, y [m] and heading [rad] (may be NaN), at most {FARTHEST:g} in size"
        raise InputError(f"pose is {quoted(mean.tolist())}, expected {expected}")
    size = len(known)
    if covariance is None:
        covariance = np.diag(np.square((POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA))[:size])
    matrix = numbers("initialize()", "covariance", covariance)
    if not _is_covariance(matrix, size):
        expected = (
            f"({size}, {size}), symmetric and positive definite, standard deviations of {NARROWEST:g} to {WIDEST:g} m"
        )
        turn = f" and up to {WIDEST_TURN:g} rad" if size == 3 else ""
        raise InputError(f"covariance is {quoted(matrix.tolist())}, expected {expected}{turn}")
    at = math.nan if t is None else seconds_of("initialize()", t)
    return PosePrior(at, mean, matrix) if size == 3 else PosePrior.at_position(at, mean[:2], matrix)


def _is_covariance(matrix: Any, size: int) -> bool:
    if matrix.shape != (size, size) or not np.all(np.isfinite(matrix)) or not np.allclose(matrix, matrix.T):
        return False
    if np.any(np.diag(matrix) > np.square((WIDEST, WIDEST, WIDEST_TURN)[:size])):
        return False
    variances = np.linalg.eigvalsh(matrix)
    return bool(variances[0] >= max(NARROWEST**2, variances[-1] / RATIO))
