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

# the search for a time shift between two signals
STEP = 0.05  # s; sampling interval of the signals, and difference between successive time shifts
FARTHEST = 2.5  # s; largest time shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # time shifts as multiples of STEP
LARGE = 0.15  # s; smallest time shift that is reported
BETTER = 0.7  # a time shift is reported if it reduces the residual to less than this fraction
FEWEST = 200  # minimum number of compared times or sightings
SLOWEST = 1.0  # s; the time shift is not searched if reference poses are further apart
Array32 = NDArray[np.float32]
Places = NDArray[np.int64]


@dataclass(frozen=True)
class Use:
    """A planned run of an estimator on a log.

    ``sensors``: names of the measurement channels that the run may use, such as "rfid". ``estimator``: the name of the
    estimator. ``settings``: the settings of the estimator. ``given``: names of the settings that the user has set.
    ``modalities``: kinds of sensors that the estimator supports. ``estimates_points``: True if the estimator can
    estimate image points that are not in the map. ``warnings``: warnings about the settings.
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

    ``final``: the trajectory estimated from all measurements. ``final_diagnostics``: its diagnostics.
    ``diagnostics``: diagnostics of the causal estimates. ``learnt``: estimated constants and landmarks.
    """

    diagnostics: Diagnostics
    final_diagnostics: Diagnostics
    learnt: Learnt
    final: Trajectory


@dataclass(frozen=True)
class Review:
    """A sensor's assessment of a finished run: ``warnings``, and the ``reliability`` of its model (None if unknown)."""

    warnings: tuple[Notice, ...] = ()
    reliability: Reliability | None = None


def lacking_section(rig: Rig, sensor: str) -> str:
    """Return the name of the section that ``sensor`` requires and ``rig`` lacks, or "" if the rig lacks none. A section
    is not required if all its settings have defaults and the rig has only one sensor of this type."""
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
    """A line of text, and optionally a table below it. ``header``: C column titles. ``rows``: R rows of C cells."""

    line: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Summary:
    """The summary of one sensor in a log, for ``fgloc info``.

    ``found``: entries of the output of ``fgloc info --json``. ``in_map``: the number of detectable elements, such as
    tags, by map layer. ``problems``: warnings. ``text``: printed paragraphs. ``undetected``: warnings about elements
    that this sensor never detects. They are not shown if another sensor of the same type detects the element.
    """

    found: Mapping[str, Any] = field(default_factory=dict)
    in_map: Mapping[str, int] = field(default_factory=dict)
    problems: Sequence[Notice] = ()
    text: Sequence[Paragraph] = ()
    undetected: Sequence[Notice] = ()


def line(name: str, shift: float, than: str, setting: str, offset: float) -> Notice:
    """Return a warning that the timestamps of the stream ``name`` differ from those of another stream, named ``than``.

    ``shift``: how much later [s] the timestamps are, negative if they are earlier. The warning proposes to set
    ``time_offset`` to ``offset`` [s] in the section ``setting`` of the rig. If ``shift`` is the largest that was tried,
    it proposes to correct ``clock_offset`` in the manifest.
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
    """Return the ``names`` that differ from a name in the map, ``in_map``, only in upper and lower case."""
    mapped = set(in_map)
    known = {name.casefold() for name in mapped}
    return [name for name in names if name not in mapped and name.casefold() in known]


@dataclass(frozen=True, eq=False)
class Marks:
    """The elements of one ``layer`` of the map, such as tags, and how plots and viewers draw them.

    ``names`` (K), ``positions`` (K, 3) [m]: the elements. ``t`` (N,), ``seen`` (N): the time [s] and the element name
    of each detection in the log. ``marker``, ``size``: the matplotlib marker. ``order``: layers with a higher order are
    drawn on top. ``dense``: True if there are too many elements to label.
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
    """Return the elements of each map layer of ``log`` and their detections, for plots. Each layer occurs once, with
    the detections by all sensors."""
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

    ``settings``: settings of the simulation. ``rig``: the rig that estimators will use. ``world``: the true world.
    ``truth``: the true trajectory, from t = 0. ``rng(name)``: returns a random generator, seeded by log and ``name``.
    ``rng_of_world(name)``: returns a random generator, seeded by world and ``name``.
    """

    settings: Any
    rig: Rig
    world: World
    truth: Trajectory
    rng: Callable[[str], np.random.Generator]
    rng_of_world: Callable[[str], np.random.Generator]

    def times(self, rate: float) -> Array:
        """Return the times (N,) [s] of the measurements during the drive of a sensor with ``rate`` measurements per
        second."""
        return times(rate, self.truth)


@dataclass(frozen=True)
class Simulated:
    """The simulated measurements of a sensor.

    ``streams``: the streams of measurements by channel. ``layers``: the map layers that differ from the true world
    because of survey errors, by name. ``metadata``: entries for the metadata of the log.
    """

    streams: Mapping[str, Stream] = field(default_factory=dict)
    layers: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)


class LiveSensor(Protocol):
    """A simulated sensor on a robot that chooses its path (active localization).

    ``rate``: measurements per second. ``decides``: True if the robot checks after each measurement of this sensor
    whether it is localized.
    """

    channel: str
    rate: float
    decides: bool

    def measure(self, t: float, pose: Array) -> Measurement:
        """Return a simulated measurement at ``t`` [s] from the robot's ``pose`` (3,)."""


def times(rate: float, truth: Trajectory) -> Array:
    """Return the times (N,) [s] of measurements during the trajectory ``truth``. ``rate``: measurements per second."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))


class Forecast(Protocol):
    """Predicts the information of a sensor's measurements on candidate paths. The map is assumed to be exact.

    ``goals`` (K, 2): positions [m] near which the sensor is most informative. K is 0 for a sensor with long range.
    """

    goals: Array

    def information(self, poses: Array, ways: Array) -> Array:
        """Return the expected Fisher information (N, 3, 3) of the measurements at each pose of a path.

        It is the information on the body-frame perturbation of the pose. ``poses`` (N, 3): the poses of the path.
        ``ways`` (N,): the length [m] of the path segment that ends at each pose. A turn on the spot counts as the
        distance that the robot would drive in the same time.
        """

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Simulate measurements of the first J of M particles on a path, and add their log-likelihoods for all
        particles to ``out``.

        ``out`` (J, M): the log-likelihood of particle m for the measurements of particle j is added to ``out[j, m]``.
        ``poses`` (S, M, 3): the pose of each particle at S points of the path. ``metres``: the length [m] of the path,
        with turns as in :meth:`information`. ``stops`` (M,): the number of these points that each particle reaches.
        ``seed``: calls with the same seed use the same random numbers.
        """
