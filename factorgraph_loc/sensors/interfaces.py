"""Argument and result types of the functions that a sensor registers.

They cover checks before a run, the review after a run, summaries for ``fgloc info``, drawings, simulated drives, and
the expected information along planned paths.
"""

from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.model.result import Reliability
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import channels, functions, sensor_of
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array

# the search for an offset between the clocks of two signals
STEP = 0.05  # s between compared times, and between tried time shifts
FARTHEST = 2.5  # s; largest time shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # time shifts as multiples of STEP
LARGE = 0.15  # s; smallest time shift that is reported
BETTER = 0.7  # a time shift is reported if it reduces the residual to less than this fraction
FEWEST = 200  # minimum number of compared times or sightings
SLOWEST = 1.0  # s; with longer intervals between reference poses nothing is compared
Array32 = NDArray[np.float32]
Places = NDArray[np.int64]


@dataclass(frozen=True)
class Use:
    """A planned run of a log by an estimator.

    ``sensors``: names of the channels that the run may use.
    ``estimator``: the name of the estimator. ``settings``: its settings. ``given``: names of the settings that the user
    has set. ``modalities``: modalities of the measurements that the estimator uses.
    ``estimates_points``: True if the estimator can estimate image points that are not in the map.
    ``warnings``: warnings about the settings.
    """

    log: Log
    sensors: tuple[str, ...]
    estimator: str
    settings: FileModel
    modalities: Container[str]
    estimates_points: bool
    given: Collection[str] = ()
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class Ending:
    """The results of a finished run.

    ``diagnostics``: diagnostics of the causal estimates. ``final_diagnostics``: diagnostics of the ``final``
    trajectory, which uses all measurements. ``learnt``: estimated constants and landmarks.
    """

    diagnostics: Diagnostics
    final_diagnostics: Diagnostics
    learnt: Learnt
    final: Trajectory


@dataclass(frozen=True)
class Review:
    """A sensor's judgement of a finished run: ``warnings``, and the ``reliability`` of the sensor's model or None."""

    warnings: tuple[Notice, ...] = ()
    reliability: Reliability | None = None


def lacking_section(rig: Rig, sensor: str) -> str:
    """Return the name of the section of the rig that a sensor requires but the rig lacks. Returns "" if nothing is
    missing. A section whose settings all have defaults is required only for one of several sensors, such as
    ``bearing_range.front``."""
    kind = kind_of(sensor)
    known = channels().get(kind)
    if known is None or not known.section:
        return ""
    section = known.section + sensor.removeprefix(kind)
    if rig.section(section) is not None:
        return ""
    fields = load(sensor_of(kind).settings[known.section].kind).model_fields.values()
    return section if kind != sensor or any(required.is_required() for required in fields) else ""


@dataclass(frozen=True)
class Paragraph:
    """A line of text. If ``header`` has C titles, a table with ``rows`` (R, C) of text follows."""

    line: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Summary:
    """The summary of one sensor in a log, for ``fgloc info``.

    ``found``: entries of the output of ``fgloc info --json``. ``in_map``: number of detectable elements of each map
    layer. ``problems``: warnings. ``text``: printed paragraphs. ``undetected``: warnings about elements that the sensor
    never detects. One of these warnings is omitted if another sensor of the same kind detects the element.
    """

    found: Mapping[str, Any] = field(default_factory=dict)
    in_map: Mapping[str, int] = field(default_factory=dict)
    problems: Sequence[Notice] = ()
    text: Sequence[Paragraph] = ()
    undetected: Sequence[Notice] = ()


def line(name: str, shift: float, than: str, setting: str, offset: float) -> Notice:
    """Return the warning that the timestamps of ``name`` are ``shift`` [s] later than those of ``than``.

    ``setting``: the section of the rig whose ``time_offset`` the warning proposes to set to ``offset`` [s]. If the
    shift is at the limit of the search, the true one may be larger, and the warning proposes to correct the manifest.
    """
    if abs(shift) > FARTHEST - STEP:
        sentence = (
            "{name}: timestamps differ by {shift:.1f} s or more from {other}: correct clock_offset in the manifest"
        )
        return notice("clocks_apart", sentence, name, FARTHEST, than)
    late = "later" if shift > 0.0 else "earlier"
    sentence = (
        "{stream}: timestamps are about {shift:.2f} s {late} than those of {other}: set {section}.time_offset = "
        "{offset:+.2f} in the rig"
    )
    return notice("time_offset", sentence, name, abs(shift), late, than, setting, offset)


def in_other_case(names: Iterable[str], in_map: Iterable[str]) -> list[str]:
    """Return the ``names`` that are in ``in_map`` only with other upper and lower case letters."""
    mapped = set(in_map)
    known = {name.casefold() for name in mapped}
    return [name for name in names if name not in mapped and name.casefold() in known]


@dataclass(frozen=True, eq=False)
class Marks:
    """The marks of one ``layer`` of the map in plots and viewers.

    ``names`` (K) and ``positions`` (K, 3) [m]: the elements of the layer. ``t`` (N,) and ``seen`` (N): time [s of the
    log] and element name of each detection. ``marker``, ``size``: matplotlib style. ``order``: layers with a higher
    order are drawn on top. ``dense``: True if there are too many elements to label.
    """

    layer: str
    names: Sequence[str]
    positions: Array
    t: Array = field(default_factory=lambda: np.empty(0))
    seen: Sequence[str] = ()
    marker: str = "d"
    size: float = 6.0
    order: float = 3.0
    dense: bool = False


def marks(log: Log) -> list[Marks]:
    """Return the drawings of all map layers of a log. Detections by several sensors in one layer are merged."""
    layers: dict[str, Marks] = {}
    for name, draw in functions("draw", log.rig):
        new: Marks = draw(log.alone(name))
        if (known := layers.get(new.layer)) is not None:
            new = replace(known, t=np.concatenate((known.t, new.t)), seen=(*known.seen, *new.seen))
        layers[new.layer] = new
    return list(layers.values())


@dataclass(frozen=True, eq=False)
class Ride:
    """A simulated drive through a world.

    ``settings``: settings of the simulation, with the sections of the sensors. ``rig``: the rig that estimators will
    use. ``world``: the true world. ``truth``: the true trajectory, from t = 0.
    ``rng``, ``rng_of_world``: return a random generator by name, from the seed of the log or of the world.
    """

    settings: Any
    rig: Rig
    world: World
    truth: Trajectory
    rng: Callable[[str], np.random.Generator]
    rng_of_world: Callable[[str], np.random.Generator]

    def times(self, rate: float) -> Array:
        """Return the measurement times (N,) [s] of a sensor with ``rate`` [Hz], from one period after the start."""
        return times(rate, self.truth)


@dataclass(frozen=True)
class Simulated:
    """The simulated measurements of a sensor.

    ``streams``: by channel. ``layers``: map layers as surveyed, if they differ from the true world. ``metadata``:
    entries for the metadata of the log.
    """

    streams: Mapping[str, Stream] = field(default_factory=dict)
    layers: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)


class LiveSensor(Protocol):
    """A simulated sensor on a robot that chooses its path (active localization).

    ``rate``: measurements per second. ``decides``: True if the robot checks after each measurement whether it is localized.
    """

    channel: str
    rate: float
    decides: bool

    def measure(self, t: float, pose: Array) -> Measurement:
        """Return a simulated measurement at ``t`` [s] from the robot's ``pose`` (3,)."""


def times(rate: float, truth: Trajectory) -> Array:
    """Return the measurement times (N,) [s] of a sensor with ``rate`` [Hz] on a drive, from one period after the start."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))


class Forecast(Protocol):
    """Predicts what a sensor will measure on candidate paths, in a world whose map is exact.

    ``goals`` (K, 2): positions [m] near which the sensor is most informative. K is 0 for a sensor with long range.
    """

    goals: Array

    def information(self, poses: Array, ways: Array) -> Array:
        """Return the expected Fisher information (N, 3, 3) on the body-frame perturbation of ``poses`` (N, 3) along a path.

        ``ways`` (N,): the length [m] of the part of the path at each pose. The duration of a turn counts as the
        distance that the robot travels in that time.
        """

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Simulate measurements from each of the first J particles along a path. Add to ``out[j, m]`` the
        log-likelihood of particle m, given the measurements from particle j.

        ``poses`` (S, M, 3): the poses of M particles at S stops on the path. ``metres``: length of the path, with turns
        as in :meth:`information`. ``stops`` (M,): number of stops at which each particle measures. ``out`` (J, M).
        Random draws are the same for all paths with the same ``seed``.
        """
