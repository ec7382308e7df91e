"""Arguments and results of the functions of sensors: the use of a sensor in a run, its summary for ``fgloc info``, its drawings,
simulated drives, and the expected information along a planned path."""

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

STEP = 0.05  # s between compared times and between shifts
FARTHEST = 2.5  # s; largest shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # in steps
LARGE = 0.15  # s; smallest shift that is reported
BETTER = 0.7  # largest ratio of the residual at a reported shift to that without a shift
FEWEST = 200  # minimum number of times and sightings
SLOWEST = 1.0  # s; longest interval between reference poses that still gives rates
Array32 = NDArray[np.float32]
Places = NDArray[np.int64]


@dataclass(frozen=True)
class Use:
    """A run of a log by an estimator.

    ``sensors``: names of the channels that can be used; ``estimator``: its name, with its ``settings``; ``given``: names of the
    settings that the user has set; ``modalities``: those of the measurements that the estimator uses; ``estimates_points``: whether
    the estimator can estimate points that are not in the map; ``warnings``: about the settings."""

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
    """The end of a run: ``diagnostics`` of the estimator and ``final_diagnostics`` of the ``final`` trajectory; what was
    ``learnt``."""

    diagnostics: Diagnostics
    final_diagnostics: Diagnostics
    learnt: Learnt
    final: Trajectory


@dataclass(frozen=True)
class Review:
    """The review of a finished run by a sensor: ``warnings`` and the ``reliability`` of its model."""

    warnings: tuple[Notice, ...] = ()
    reliability: Reliability | None = None


def lacking_section(rig: Rig, sensor: str) -> str:
    """The section that a sensor requires, because its settings have no defaults, if the rig lacks it, else ""."""
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
    """A line, and a table below it if it has a ``header``: cells (R, C) of text."""

    line: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Summary:
    """The summary of one sensor in a log.

    ``found``: entries of ``fgloc info --json``; ``in_map``: number of detectable elements by map layer; ``problems``: warnings, one
    line each; ``text``: printed paragraphs. ``undetected``: problems that are none if another sensor of the kind lacks them.
    """

    found: Mapping[str, Any] = field(default_factory=dict)
    in_map: Mapping[str, int] = field(default_factory=dict)
    problems: Sequence[Notice] = ()
    text: Sequence[Paragraph] = ()
    undetected: Sequence[Notice] = ()


def line(name: str, shift: float, than: str, setting: str, offset: float) -> Notice:
    """The warning that ``name`` is stamped ``shift`` [s] later than ``than``, with the ``time_offset`` [s] that corrects it.

    A shift at the end of the search may be larger."""
    if abs(shift) > FARTHEST - STEP:
        sentence = "{name} is stamped {shift:.1f} s or more apart from {other}: correct clock_offset in the manifest"
        return notice("clocks_apart", sentence, name, FARTHEST, than)
    late = "later" if shift > 0.0 else "earlier"
    sentence = "{stream} is stamped about {shift:.2f} s {late} than {other}: set {section}.time_offset = {offset:+.2f} in the rig"
    return notice("time_offset", sentence, name, abs(shift), late, than, setting, offset)


def in_other_case(names: Iterable[str], in_map: Iterable[str]) -> list[str]:
    """The ``names`` that the map has only with other capital letters."""
    mapped = set(in_map)
    known = {name.casefold() for name in mapped}
    return [name for name in names if name not in mapped and name.casefold() in known]


@dataclass(frozen=True, eq=False)
class Marks:
    """A ``layer`` of the map: ``names`` (K) of its elements and ``positions`` (K, 3) [m].

    ``t`` (N,) [s of the log], ``seen`` (N) names: detections. ``marker``, ``size``, ``order``: matplotlib style, lowest order
    first. ``dense``: whether there are too many elements to label.
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
    """The marks of all sensors for a log and its map, one of each layer."""
    layers: dict[str, Marks] = {}
    for name, draw in functions("draw", log.rig):
        new: Marks = draw(log.alone(name))
        if (known := layers.get(new.layer)) is not None:
            new = replace(known, t=np.concatenate((known.t, new.t)), seen=(*known.seen, *new.seen))
        layers[new.layer] = new
    return list(layers.values())


@dataclass(frozen=True, eq=False)
class Ride:
    """A drive through a world: the ``truth`` from t = 0, the ``rig`` given to estimators, and the true ``world``.

    ``settings``: of the simulation, with the sections of the sensors. ``rng``, ``rng_of_world``: random generators by name, from
    the seeds of the log and of the world.
    """

    settings: Any
    rig: Rig
    world: World
    truth: Trajectory
    rng: Callable[[str], np.random.Generator]
    rng_of_world: Callable[[str], np.random.Generator]

    def times(self, rate: float) -> Array:
        """Times (N,) of a sensor with ``rate`` [Hz], starting after one period."""
        return times(rate, self.truth)


@dataclass(frozen=True)
class Simulated:
    """The streams of a sensor's channels. ``layers``: of the surveyed world, if it differs from the true one; ``metadata`` of
    the log."""

    streams: Mapping[str, Stream] = field(default_factory=dict)
    layers: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)


class LiveSensor(Protocol):
    """A simulated sensor of an active robot with ``rate`` [Hz]. ``decides``: whether the robot checks after each measurement if it
    is localized."""

    channel: str
    rate: float
    decides: bool

    def measure(self, t: float, pose: Array) -> Measurement:
        """The measurement at ``t`` [s] from pose (3,)."""


def times(rate: float, truth: Trajectory) -> Array:
    """Times (N,) of a sensor on a drive, starting after one period."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))


class Forecast(Protocol):
    """The forecast of one sensor in a world whose map is exact. ``goals`` (K, 2) [m]: positions near which it is most
    informative; empty for a sensor with long range."""

    goals: Array

    def information(self, poses: Array, ways: Array) -> Array:
        """Expected Fisher information (N, 3, 3) on the body-frame perturbation of poses (N, 3). ``ways`` (N,) [m]: distance
        travelled at each pose; turns count by their duration."""

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Add the log-likelihoods (M,) of measurements that the first J particles might make on a path to ``out`` (J, M).

        ``poses`` (S, M, 3): where particles measure; ``metres``: length of the path, with turns by their duration; ``stops``
        (M,): number of measurements of each particle. Random draws are the same for all paths with one ``seed``.
        """
