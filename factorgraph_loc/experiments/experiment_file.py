"""The experiment file: lists of logs, estimators, sets of sensors, seeds and swept settings to combine."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.scores import SUMMARY
from factorgraph_loc.evaluation.warned import SIMULATION
from factorgraph_loc.files.models import (
    FileModel,
    check_content,
    flattened,
    nearest,
    parse_model,
    read_toml,
    set_key,
    write_text,
)
from factorgraph_loc.model.scoring import (
    LARGEST_SEED,
    LONGEST,
    MAX_GAP,
    MOST_SEEDS,
    SHORTEST,
    TICK_GAP,
    Alignment,
    parse_seeds,
)
from factorgraph_loc.text import listed, plain, quoted

LONGEST_NAME = 200  # maximum characters of the experiment's name, which is a folder name
MOST = 1000  # maximum number of logs, estimators, sets of sensors and metrics in a file; globs and seeds may expand to more
MOST_RUNS = 100_000  # maximum number of runs
NO_TIME_LIMIT = 1e9  # s; time limit of a run that is never reached
MOST_SWEPT, MOST_VALUES = 50, 10_000  # maximum number of swept settings, and of values of one setting
FIRST = """\
name = "{name}"  # the results go to out/{name}
logs = [{{ simulate = "office", seeds = "0:3" }}]  # or names and files of logs: ["plaza1", "monday.toml"]
estimators = ["ekf", "smoother"]
# sensors = ["odometry", "rfid"]  # default: the sensors of each rig
# prior = "unknown"  # start pose; default: the start in the log
# seeds = "0:5"  # random seeds of estimators that draw random numbers

# [sweep]  # values of settings, by estimator
# "smoother.lag" = [5.0, 10.0, 20.0]

[report]
baseline = "ekf"  # other estimators are compared with this one
"""
Name = Annotated[str, Field(min_length=1)]
Seeds = Annotated[
    tuple[Annotated[int, Field(ge=0, le=LARGEST_SEED)], ...], Field(min_length=1, max_length=MOST_SEEDS, fail_fast=True)
]
Scalar = str | int | float | bool


def _is_scalar(value: Any) -> bool:
    """True if a value is a text, a boolean or a finite number."""
    return isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


def _seeds(value: Any) -> Any:
    """Return seeds as a tuple: "0:5" becomes (0, 1, 2, 3, 4), and 3 becomes (3,). Other values are unchanged."""
    if isinstance(value, int) and not isinstance(value, bool):
        return (value,)
    if isinstance(value, str):
        try:
            return tuple(parse_seeds(value, "the value"))
        except InputError as error:
            raise ValueError(str(error)) from error
    return value


class LogEntry(FileModel):
    """Logs in an experiment file: either recorded logs (``log``) or simulated logs (``simulate``).

    ``log``: a name that ``fgloc datasets`` lists, a path relative to the experiment file, or a glob of names or paths.
    With ``log`` there may be a ``reader`` with its ``options``, and files ``rig`` and ``world`` that replace those of
    the log. ``simulate``: a preset or a TOML file. With ``simulate`` there may be ``settings`` of the simulation, and
    ``seeds``. There is one simulated log per seed.
    """

    log: Name | None = None
    reader: Name | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    rig: Name | None = None
    world: Name | None = None
    simulate: Name | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    seeds: Seeds = (0,)

    _parse_seeds = field_validator("seeds", mode="before")(_seeds)

    @model_validator(mode="after")
    def _is_one(self) -> LogEntry:
        if (self.log is None) == (self.simulate is None):
            raise ValueError("expected either log or simulate")
        unusable = ("settings", "seeds") if self.log is not None else ("reader", "options", "rig", "world")
        if wrong := [name for name in unusable if name in self.model_fields_set]:
            raise ValueError(f"{wrong[0]} cannot be used with {'log' if self.log is not None else 'simulate'}")
        return self


class EstimatorEntry(FileModel):
    """An estimator in an experiment file. ``name``: of the estimator. ``settings``: {key: value} that replace its
    defaults. ``label``: its name in the results. If it is "", the results have ``name``."""

    name: Name
    label: str = ""
    settings: dict[str, Any] = Field(default_factory=dict)

    @property
    def shown(self) -> str:
        """The label of the estimator, or its name if it has no label."""
        return self.label or self.name


class Sweep(FileModel):
    """The settings that an experiment varies.

    ``over``: {name of a setting: list of its values}. The name is ``LABEL.KEY``, with the label of an estimator, or
    ``simulation.KEY``. ``mode``: "grid" for all combinations of the values. "list" combines the first values of all
    settings, then the second values, and so on.
    """

    mode: Literal["grid", "list"] = "grid"
    over: Mapping[str, tuple[Scalar, ...]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _flatten(cls, content: Any) -> Any:
        if not isinstance(content, Mapping):
            return content
        rest = {key: value for key, value in content.items() if key != "mode"}
        mode = {"mode": content["mode"]} if "mode" in content else {}
        over = dict(flattened(rest))
        if len(over) > MOST_SWEPT:
            raise ValueError(f"{len(over):,} settings are swept, expected at most {MOST_SWEPT}")
        for key, values in over.items():
            if not isinstance(values, list | tuple) or not 0 < len(values) <= MOST_VALUES:
                raise ValueError(f"{plain(key)} is {quoted(values)}, expected a list of 1 to {MOST_VALUES:,} values")
            if wrong := [value for value in values if not _is_scalar(value)]:
                raise ValueError(f"{plain(key)} has {quoted(wrong[0])}, expected text, finite numbers, true or false")
        return mode | {"over": over}

    @model_validator(mode="after")
    def _in_step(self) -> Sweep:
        if self.mode == "list" and len({len(values) for values in self.over.values()}) > 1:
            raise ValueError(f'mode is "list", expected equal numbers of values for {listed(self.over)}')
        return self

    def points(self, *words: str) -> list[dict[str, Scalar]]:
        """Return the combinations of values of swept settings, without duplicates. Each is {dotted name: value}.

        ``words``: the first parts of the dotted names that are combined, such as "simulation". Without ``words`` all
        settings are combined. Without settings, the result is [{}]. At most :data:`MOST_RUNS` + 1 combinations are
        returned.
        """
        columns = {key: values for key, values in self.over.items() if not words or key.partition(".")[0] in words}
        combined: Iterable[tuple[Scalar, ...]] = itertools.product(*map(dict.fromkeys, columns.values()))
        if self.mode == "list":
            combined = dict.fromkeys(zip(*columns.values(), strict=True)) or [()]
        return [dict(zip(columns, values, strict=True)) for values in itertools.islice(combined, MOST_RUNS + 1)]


class ReportSettings(FileModel):
    """Settings of the report. ``metrics``: keys of its scores. ``baseline``: label of the estimator to compare with."""

    metrics: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MOST, fail_fast=True)] = SUMMARY
    baseline: str | None = None


class Limits(FileModel):
    """Limits of one run. ``memory``: memory of its process [10^6 bytes]. ``time``: computing time [s].

    The default of ``memory`` is 90 % of the machine's memory, divided by the number of processes.
    """

    memory: Annotated[float, Field(gt=0.0)] | None = None
    time: Annotated[float, Field(gt=0.0)] = 3600.0


class Experiment(FileModel):
    """The content of an experiment file.

    ``name``: name of the experiment. ``out``: folder of the results, None for out/NAME. ``logs``, ``estimators``: every
    estimator runs on every log. ``sensors``: sets of used sensors. Runs are made with each set. A set of None means all
    sensors of the log's rig. ``prior``: the start pose, such as "log" or "unknown", see
    :func:`~factorgraph_loc.experiments.preparation.resolve_prior`. ``seeds``: random seeds of the estimators.
    ``max_gap`` [s]: for scores, estimates are not interpolated across longer gaps. ``tick_gap`` [s]: in longer gaps
    between measurements there are no estimates. ``align``: there are also scores after this alignment with the
    reference. ``sweep``: settings to vary. ``report``: settings of the report. ``limits``: time and memory of a run.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$", max_length=LONGEST_NAME)]
    out: Name | None = None
    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1, max_length=MOST, fail_fast=True)]
    estimators: Annotated[tuple[EstimatorEntry, ...], Field(min_length=1, max_length=MOST, fail_fast=True)]
    sensors: Annotated[
        tuple[Annotated[tuple[Name, ...], Field(max_length=MOST, fail_fast=True)] | None, ...],
        Field(min_length=1, max_length=MOST, fail_fast=True),
    ] = (None,)
    prior: Name | None = None
    seeds: Seeds = (0,)
    max_gap: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = MAX_GAP
    tick_gap: Annotated[float, Field(ge=SHORTEST, le=LONGEST)] = TICK_GAP
    align: Alignment = "none"
    sweep: Sweep = Sweep()
    report: ReportSettings = ReportSettings()
    limits: Limits = Limits()

    _parse_seeds = field_validator("seeds", mode="before")(_seeds)

    @field_validator("logs", "estimators", mode="before")
    @classmethod
    def _named(cls, value: Any, info: Any) -> Any:
        """Return entries of ``logs`` or ``estimators`` as tables: a name becomes a table such as {"name": "ekf"}."""
        key = "log" if info.field_name == "logs" else "name"
        return (
            [{key: entry} if isinstance(entry, str) else entry for entry in value] if isinstance(value, list) else value
        )

    @field_validator("sensors", mode="before")
    @classmethod
    def _several(cls, value: Any) -> Any:
        return [value] if isinstance(value, list) and value and all(isinstance(name, str) for name in value) else value

    @model_validator(mode="after")
    def _fits(self) -> Experiment:
        labels = [entry.shown for entry in self.estimators]
        if twice := [label for label, count in Counter(labels).items() if count > 1]:
            raise ValueError(f"two estimators are called {quoted(twice[0])}, expected different labels")
        known = {SIMULATION, *labels, *(entry.name for entry in self.estimators)}
        for key in self.sweep.over:
            first, _, rest = key.partition(".")
            if first not in known or not rest:
                raise ValueError(
                    f"sweep has {quoted(key)}{nearest(first, list(known))}; expected LABEL.KEY or simulation.KEY"
                )
            if first == SIMULATION and not any(entry.simulate for entry in self.logs):
                raise ValueError(f"sweep has {quoted(key)}, but no log is simulated")
        baseline = self.report.baseline
        if baseline is not None and baseline not in labels:
            raise ValueError(f"report.baseline is {quoted(baseline)}{nearest(baseline, labels)}")
        return self


def write_new(file: Path, *, overwrite: bool = False) -> None:
    """Write an example of an experiment file, with comments. Raises InputError if it exists, without ``overwrite``."""
    if file.suffix != ".toml":
        raise InputError(f"{file}: the name of an experiment file must end in .toml")
    if file.exists() and not overwrite:
        raise InputError(f"{file}: exists already; choose another name or give --overwrite")
    write_text(file, FIRST.format(name=file.stem))


def read_experiment(path: Path, changes: Mapping[str, Any] | None = None) -> Experiment:
    """Return the experiment in a TOML file.

    ``changes``: {dotted key: value} that replace values of the file. The key ``LABEL.KEY`` is a setting of an
    estimator, and ``simulation.KEY`` a setting of all simulated logs. Raises InputError with file and key if a value is
    invalid.
    """
    content = read_toml(path)
    for key, value in (changes or {}).items():
        _change(content, key, value, path)
    check_content(content, path)
    return parse_model(Experiment, content, path)


def _change(content: dict[str, Any], key: str, value: Any, source: object) -> None:
    """Set the value of a dotted ``key``, such as "smoother.lag", in the ``content`` of a file. ``source``: name of the
    file."""
    first, _, rest = key.partition(".")
    if first in Experiment.model_fields:
        set_key(content, key, value, source)
        return
    logs = [log for log in _tables(content, "logs", "log", source) if "simulate" in log]
    estimators = _tables(content, "estimators", "name", source)
    chosen = logs if first == SIMULATION else [e for e in estimators if first in (e.get("label"), e.get("name"))]
    if not chosen or not rest:
        labels = [str(e.get("label", e.get("name"))) for e in estimators]
        raise InputError(
            f"{source}: no key {plain(key)}{nearest(first, [*Experiment.model_fields, SIMULATION, *labels])}"
        )
    for entry in chosen:
        set_key(entry, f"settings.{rest}", value, source)


def _tables(content: dict[str, Any], key: str, named: str, source: object) -> list[dict[str, Any]]:
    """Return the list ``key`` in the content of a file. An entry that is only a name becomes {``named``: name}.

    Raises InputError if the value is not a list of names or tables.
    """
    entries = content.setdefault(key, [])
    if not isinstance(entries, list):
        raise InputError(f"{source}: {key} is {quoted(entries)}, expected a list")
    entries[:] = [{named: entry} if isinstance(entry, str) else entry for entry in entries]
    if wrong := [entry for entry in entries if not isinstance(entry, dict)]:
        raise InputError(f"{source}: {key} has {quoted(wrong[0])}, expected names or tables")
    return entries


def canonical(settings: Mapping[str, Any]) -> str:
    """Return settings as JSON with sorted keys, so that equal settings have equal texts."""
    return json.dumps(settings, sort_keys=True)
