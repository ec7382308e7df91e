"""Where a robot is while it drives: measurements are pushed as they come, estimates are pulled when they are wanted."""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.files.values import seconds_of
from factorgraph_loc.fusion import registry
from factorgraph_loc.fusion.base import Estimator, ForgettingEstimator, finds_heading
from factorgraph_loc.fusion.guarded import Guard, sound, sound_belief, sound_trajectory
from factorgraph_loc.live.start import prior_of, require_options, usable_sensors
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.learnt import Learnt
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.ticks import Ticks
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.camera.prepare import frontend_of, uses_images
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.pushed import checked
from factorgraph_loc.sensors.registry import channels
from factorgraph_loc.sensors.rfid.pushed import RfidRead, scan_of

if TYPE_CHECKING:
    from factorgraph_loc.sensors.camera.live import LiveFrontend

LAG = 10.0  # s: the window of the smoother, where the settings do not say another
HISTORY = 60.0  # s
TIDY_INTERVAL = 5.0  # s of measurements between two times that the past is forgotten
ROWS_KEPT = 1000  # of each list of diagnostics
AHEAD = 3600.0  # s: a stamp that is so much newer than all others is of another clock


class Localizer:
    """An estimator that any number of threads push measurements into and pull estimates from.

    ``rig`` and ``world``: robot and map. ``estimator``: its name; ``settings``: overrides of its settings. The smoother has a
    fixed lag of 10 s unless ``settings`` say another; with ``lag = None`` it keeps all, as ``batch`` and ``space_batch`` do.
    ``sensors``: those that may be used, by default the rig's; what is pushed of others is counted as ignored. ``history`` [s]: how
    long the past is kept that :meth:`trajectory` tells; with that, memory is bounded. ``seed``: of the random generator.

    Its life: :meth:`initialize`, then measurements and estimates in any order. :meth:`initialize` once more begins anew. There is
    nothing to close. Stamps are seconds by any clock that all sensors share; the offsets that the rig knows are added here. One
    lock guards the estimator: who pushes waits while another's measurement is taken in, so that nothing piles up.

    The same measurements in the same order give the same results, whatever is asked in between. InputError if the settings,
    sensors or ``history`` are wrong.
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
        self._history, self._seed = history, seed
        self._lock = threading.Lock()
        self._image_lock = threading.Lock()
        self._frontend: LiveFrontend | None = None
        self._begin_anew(None, None, Guard(estimator))

    def initialize(
        self, pose: ArrayLike | None = None, covariance: ArrayLike | None = None, t: float | None = None
    ) -> None:
        """Begin, or begin anew, at a ``pose`` (3,), x, y [m] and heading [rad] in the world's frame; None: anywhere in the map. A
        heading of NaN may be any: nothing is ``localized`` until what is seen has told it.

        ``covariance`` (3, 3) of the pose, or (2, 2) of the position where the heading is NaN, by default that of 0.05 m and
        0.05 rad. ``t`` [s]: when the robot is there, by default at the first measurement. Odometry from before then is taken in,
        as its velocity holds on; other measurements are ignored.
        InputError if these are no pose, or if the estimator cannot begin from an unknown one; RunFailedError if it cannot begin
        there. All goes on as before then.
        """
        start = None if pose is None else prior_of(pose, covariance, t)
        setup = model_setup.Setup(self._rig, self._world, self._sensors, np.random.default_rng(self._seed))
        guard = Guard(self._name)
        with guard:
            new = registry.create(self._name, setup, self._settings)
        if start is None and not getattr(new, "supports_unknown_start", False):
            raise InputError(f"{self._name} cannot start from an unknown pose with this rig and map, expected a pose")
        if start is not None and getattr(new, "starts_in_space", False):
            raise InputError(f"{self._name} begins at a pose in space, expected an estimator that begins on a floor")
        if start is not None and not start.has_heading and not finds_heading(new):
            raise InputError(f"{self._name} cannot find an unknown heading with this rig and map, expected one")
        if start is not None and not math.isnan(start.t):
            with guard.telling(f"the start at {start.t:.3f} s"):
                new.initialize(start)
        with self._lock:
            self._begin_anew(new, start, guard)

    def push(self, measurement: Measurement) -> None:
        """Take a measurement, in the order of arrival: one that is late goes in at its time if it is late by at most the
        estimator's ``max_delay``, else it is counted and dropped.

        InputError if it has a value that cannot be, such as NaN, or comes before :meth:`initialize`; if a stamp is an hour ahead
        of all others; if increments of odometry go back in time, whose meaning depends on their order. It is not taken then, and
        nothing else has changed. RunFailedError if the estimator fails: it is lost. Whatever is pushed or asked from then on
        raises the same error, until :meth:`initialize` begins anew; only :meth:`diagnostics` still tells what there was.
        Tags, antennas and landmarks that rig and map lack are no errors: they are counted, see :meth:`diagnostics`.
        """
        own = checked(measurement)
        with self._lock:
            self._take(own)

    def push_reads(self, t: float, antennas: Iterable[str], reads: Iterable[RfidRead] = ()) -> None:
        """Take what was read in inventory rounds that ended at ``t``. ``antennas``: those that listened, also if they read nothing:
        that tags were not read tells as much. InputError as of :meth:`push`."""
        self.push(scan_of(t, antennas, reads))

    def push_image(self, t: float, image: object) -> None:
        """Take an image, an array (H, W) or (H, W, 3) BGR of the size that the rig's camera has.

        Its features are looked for in the calling thread, while other measurements go on: it arrives late by the time that takes.
        InputError as of :meth:`push`, or if it is no such image.
        """
        t = seconds_of("image", t)
        if self._rig.find(CameraSettings) is None:
            raise InputError(f"image at {t:.3f} s: the rig {self._rig.name} has no [camera] that tells where it looks")
        modalities = getattr(registry.estimator_type(self._name), "modalities", ())
        if not uses_images(self._sensors, modalities):
            with self._lock:
                self._begun(f"image at {t:.3f} s").diagnostics.ignore("images")
            return
        with self._image_lock:
            if self._frontend is None:
                # imported here, as without images no OpenCV is needed
                from factorgraph_loc.sensors.camera.live import LiveFrontend  # noqa: PLC0415

                self._frontend = LiveFrontend(frontend_of(self._rig, self._world), self._rig.of(CameraSettings).model())
            frame = self._frontend.frame(t, image)
        self.push(frame)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The pose at the newest stamp of all measurements, or at ``t`` if that is later still, where the odometry leads.

        It changes nothing: what is measured before ``t`` will not be late.

        Before there is anything to tell it is ``unlocalized``, and not a number. RunFailedError if the estimator has failed, or has
        no pose of finite numbers with a positive covariance then; that loses nothing.
        """
        with self._lock:
            return self._estimate(t)

    def belief(self) -> Belief:
        """All that is believed at the time of :meth:`estimate`: modes, and particles of an estimator that has them. RunFailedError
        as there."""
        with self._lock:
            self._require_whole()
            if self._estimator is None or not self._is_under_way(self._newest):
                return Belief(())
            with self._guard.telling(f"the belief at {self._newest:.3f} s"):
                return copy.deepcopy(sound_belief(self._estimator.belief(self._newest)))

    def trajectory(self) -> Trajectory:
        """The best estimate of the past, with what came later: ten times a second from the start to before the newest stamp, of the
        last ``history`` seconds, or somewhat more."""
        with self._lock:
            self._require_whole()
            if self._estimator is None or self._ticks is None or not self._ticks.count:
                return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
            with self._guard.telling("the trajectory"):
                return copy.deepcopy(sound_trajectory(self._estimator.trajectory()))

    def learnt(self) -> Learnt:
        """What is estimated beside the pose: constants of the sensors, landmarks, points; with what came later, as
        :meth:`trajectory` has them, and in the time that this takes."""
        with self._lock:
            self._require_whole()
            if self._estimator is None:
                return Learnt()
            with self._guard.telling("what was learnt"):
                return copy.deepcopy(self._estimator.learnt())

    def diagnostics(self) -> Diagnostics:
        """What was ignored, rejected or too late, by reason, since the beginning; the last innovations, residuals and events."""
        with self._lock:
            return Diagnostics() if self._estimator is None else copy.deepcopy(self._estimator.diagnostics)

    def _begin_anew(self, estimator: Estimator | None, prior: PosePrior | None, guard: Guard) -> None:
        self._estimator = estimator
        self._guard = guard
        self._failure: RunFailedError | None = None  # what the estimator was lost by
        self._prior = prior  # its time is NaN until the first measurement tells it
        # from the first measurement on, or from the prior's time
        self._ticks = None if prior is None or math.isnan(prior.t) else Ticks(prior.t)
        self._newest = self._tidied = -math.inf
        self._last: PoseEstimate | None = None  # nothing has changed since
        known = channels()
        self._sequences: dict[str, Any] = {
            name: load(known[name].sequence)(self._rig, self._world) for name in self._sensors if known[name].sequence
        }

    def _require_whole(self) -> None:
        if self._failure is not None:
            raise RunFailedError(str(self._failure)) from self._failure

    def _begun(self, what: str) -> Estimator:
        self._require_whole()
        if self._estimator is None:
            raise InputError(f"{what} came before initialize(), expected that first")
        return self._estimator

    def _take(self, m: Measurement) -> None:
        estimator = self._begun(f"{type(m).__name__} at {m.t:.3f} s")
        if m.sensor not in self._sensors:
            estimator.diagnostics.ignore(f"{m.sensor} is not among the sensors")
            return
        m = _moved(m, self._rig.time_offset(m.sensor))
        self._check_stamp(m)
        self._newest, self._last = max(self._newest, m.t), None
        try:
            self._feed(estimator, m)
        except BaseException as error:  # an interrupt, too, leaves it half changed
            if isinstance(error, RunFailedError):
                self._failure = error
            else:
                self._failure = RunFailedError(f"{self._name}: lost by {type(error).__name__}; initialize() it anew")
            raise
        self._tidy(estimator)

    def _feed(self, estimator: Estimator, m: Measurement) -> None:
        if self._ticks is None:
            self._ticks = Ticks(m.t)
            if self._prior is not None:
                self._prior = replace(self._prior, t=m.t)
                with self._guard.telling(f"the start at {m.t:.3f} s"):
                    estimator.initialize(self._prior)
        # as in a run of a log: a tick comes after all that was measured by then
        for t in self._ticks.before(m.t):
            self._guard.process(estimator, Tick(t))
        if not m.is_motion and not self._is_under_way(m.t):
            estimator.diagnostics.ignore("before the start")
            return
        self._guard.process(estimator, m)

    def _check_stamp(self, m: Measurement) -> None:
        where = f"{type(m).__name__} at {m.t:.3f} s"
        if math.isfinite(self._newest) and m.t > self._newest + AHEAD:
            raise InputError(
                f"{where}: is {m.t - self._newest:.0f} s ahead of all others, expected the same clock, or initialize() "
                f"after a pause"
            )
        if m.sensor in self._sequences:
            self._sequences[m.sensor].require(m, where)

    def _is_under_way(self, t: float) -> bool:
        """Whether there is something to tell of ``t``: it is not before the start, nor before the first measurement."""
        return math.isfinite(t) and (self._prior is None or t >= self._prior.t)

    def _estimate(self, t: float | None) -> PoseEstimate:
        self._require_whole()
        at = self._newest if t is None else max(self._newest, seconds_of("estimate()", t))
        if self._last is not None and self._last.t == at:
            return copy.deepcopy(self._last)
        if self._estimator is None or not math.isfinite(self._newest) or not self._is_under_way(at):
            return PoseEstimate(math.nan, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        if at > self._newest + AHEAD:
            raise InputError(
                f"t is {at:.3f} s, {at - self._newest:.0f} s ahead of all measurements, expected their clock"
            )
        with self._guard.telling(f"the estimate at {at:.3f} s"):
            found = sound(self._estimator.estimate(at))
        # the estimator may use its arrays again
        self._last = copy.deepcopy(replace(found, t=at))
        return copy.deepcopy(self._last)

    def _tidy(self, estimator: Estimator) -> None:
        """Forget what lies too far back, every few seconds."""
        if self._newest < self._tidied + TIDY_INTERVAL:
            return
        self._tidied = self._newest
        if isinstance(estimator, ForgettingEstimator) and self._ticks is not None and self._ticks.count:
            estimator.forget(self._newest - self._history)
        estimator.diagnostics.keep_last(ROWS_KEPT)


def _moved(m: Measurement, offset: float) -> Measurement:
    """The same measurement by the clock that all sensors share."""
    moved: Measurement = replace(m, t=m.t + offset)  # type: ignore[type-var]
    return moved
