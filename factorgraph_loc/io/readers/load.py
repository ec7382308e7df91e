"""Loads logs in any format. Each format has a reader: a module with a model ``Options`` and a function ``read(path, options)``."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import kind
from factorgraph_loc.files.column_mapping import JSON_SUFFIXES
from factorgraph_loc.files.data_root import EXPECTED, RUN_FILE, find_data_root, named_path
from factorgraph_loc.files.models import nearest, parse_model, read_toml
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.io.bags.file import is_bag, require_metadata
from factorgraph_loc.io.checks import log_warnings, require_bounds, without_false_headings
from factorgraph_loc.io.motions import with_wheels_in, with_wheels_of
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, read_rig
from factorgraph_loc.io.native.world_file import read_world
from factorgraph_loc.io.readers import pyfg
from factorgraph_loc.io.readers.manifests import Manifest, read_manifest
from factorgraph_loc.io.readers.pose_file import is_pose_file
from factorgraph_loc.model.log import RIG_NOTES, Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import READERS
from factorgraph_loc.text import listed, notice, quoted

LogLike = Log | str | Path
RigLike = Rig | str | Path
WorldLike = World | str | Path
MOST = 1000  # maximum number of logs that lists of option values may give
TABLES = (".csv", *JSON_SUFFIXES)
T = TypeVar("T")


def reader(name: str) -> Any:
    """Return the module that reads the format ``name``. Raises InputError with the most similar name if none does."""
    if name not in READERS:
        raise InputError(f"there is no reader {quoted(name)}{nearest(name, list(READERS))}")
    return READERS[name]


@dataclass(frozen=True)
class _Source:
    """Describes where a log is and how it is read.

    ``reader``: name of the reader. ``path``: the file or folder to read. ``name``: name of the log, None if the reader
    names it. ``manifest``: the manifest that describes the log, if there is one. ``file``: the file of the manifest."""

    reader: str
    path: Path | None
    name: str | None = None
    manifest: Manifest | None = None
    file: Path = Path()

    def named(self, what: str, data_root: str | Path | None) -> Path | None:
        """Return the path of the rig file or world file that the manifest names, or None if it names none.

        ``what``: ``rig`` or ``world``. ``data_root``: the folder of data sets, by default the environment variable FGLOC_DATA.
        """
        name = getattr(self.manifest, what, None)
        expected = f"{EXPECTED}; or `--{what} FILE` in its place"
        return None if name is None else named_path(self.file.parent, name, self.file, data_root, expected)


def load(
    log: LogLike,
    *,
    data_root: str | Path | None = None,
    reader: str | None = None,
    options: Mapping[str, Any] | None = None,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
) -> list[Log]:
    """Return the logs that ``log`` refers to.

    ``log``: a manifest, a folder in the native format or its ``run.toml``, the name of a shipped data set, or a
    ``Log``. ``reader``: if given, ``log`` is any path that this reader can read. ``options``: options of the reader,
    overriding the manifest. An option whose value is a list, or a text with commas, gives one log per element. ``rig``,
    ``world``: values or files that replace the rig and the world of the log. ``data_root``: the folder of data sets; by
    default the environment variable FGLOC_DATA. Raises InputError with a message of one line about what is invalid.
    """
    if isinstance(log, Log):
        return [replace(log, rig=_value(rig, read_rig) or log.rig, world=_value(world, read_world) or log.world)]
    source = _find(str(log), data_root, reader)
    new_rig = _value(source.named("rig", data_root) if rig is None else rig, read_rig)
    new_world = _value(source.named("world", data_root) if world is None else world, read_world)
    given = dict(options or {})
    described = source.manifest.options if source.manifest else {}
    choices = {key: _choices(value) for key, value in described.items()}
    # a list from the command line is a text with commas
    choices |= {
        key: [part.strip() for part in value.split(",")] if isinstance(value, str) else _choices(value)
        for key, value in given.items()
    }
    if (count := math.prod(map(len, choices.values()))) > MOST:
        raise InputError(f"{log}: the lists in its options give {count:,} logs, expected at most {MOST:,}")
    if empty := [key for key, values in choices.items() if not values]:
        raise InputError(f"{log}: option {empty[0]} is an empty list, expected a value or several")
    naming = [
        key
        for key, values in choices.items()
        if (key in given or len(values) > 1) and not any(isinstance(value, Mapping) for value in values)
    ]
    return [
        _read(source, new_rig, new_world, dict(zip(choices, values, strict=True)), naming)
        for values in itertools.product(*choices.values())
    ]


def load_all(
    logs: LogLike | Sequence[LogLike], rig: RigLike | None = None, world: WorldLike | None = None
) -> list[Log]:
    """Return a list of all logs that ``logs`` refers to: files, names of shipped data sets, or ``Log`` objects.

    ``rig``, ``world``: if not None, they replace those of the logs.
    """
    several = [logs] if isinstance(logs, (Log, str, Path)) else logs
    return [loaded for log in several for loaded in load(log, rig=rig, world=world)]


def read_log(
    log: LogLike,
    *,
    data_root: str | Path | None = None,
    reader: str | None = None,
    options: Mapping[str, Any] | None = None,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
) -> Log:
    """Return the one log that ``log`` refers to: a manifest, a folder in the native format, or a shipped data set.

    ``reader``, ``options``: the reader and its options, overriding the manifest. ``rig``, ``world``: replace those of
    the log. ``data_root``: the folder of data sets, by default FGLOC_DATA. Raises InputError if there are several logs."""
    logs = load(log, data_root=data_root, reader=reader, options=options, rig=rig, world=world)
    if len(logs) > 1:
        raise InputError(f"{log} refers to {len(logs)} logs, expected one: {listed(loaded.name for loaded in logs)}")
    return logs[0]


def _value(given: T | str | Path | None, read: Callable[[str | Path], T]) -> T | None:
    """Return ``given``. If it is the name of a file, return ``read(given)`` instead."""
    return read(given) if isinstance(given, str | Path) else given


def _choices(value: Any) -> list[Any]:
    """Return the values of an option as a list. An option that is not a list has one value."""
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _find(log: str, data_root: str | Path | None, named: str | None) -> _Source:
    path = Path(log)
    if named is not None:
        reader(named)  # report a wrong reader before a wrong path
    if kind(path) not in ("", "a file", "a folder"):
        raise InputError(f"{log}: is {kind(path)}, expected a file or a folder")
    if named is not None:
        if not path.exists():
            raise InputError(f"{log}: does not exist")
        name = path.resolve().stem if path.is_file() else path.resolve().name
        return _Source(named, path, None if named == "native" else name)
    if path.is_dir() and (path / RUN_FILE).is_file():
        path /= RUN_FILE
    if path.exists() and is_bag(path):
        raise InputError(f"{log}: is a ROS bag: `fgloc manifest {log} > run.toml` proposes how to read it")
    if path.is_file():
        return _from_file(log, path, data_root)
    known = manifests()
    if log in known:
        return _from_manifest(known[log], data_root)
    if path.is_dir():
        require_metadata(path)
        raise InputError(
            f"{log}: has no {RUN_FILE}, so it is not in the native format: write a manifest with `fgloc manifest {log}`, "
            "or name the reader of its format with --reader"
        )
    raise InputError(f"{log}: is neither a file, nor a folder, nor a known data set{nearest(log, list(known))}")


def _from_file(log: str, path: Path, data_root: str | Path | None) -> _Source:
    if path.name == RUN_FILE and "reader" not in read_toml(path):  # a manifest may have this name too
        return _Source("native", path.parent)
    if path.suffix == ".toml":
        return _from_manifest(path, data_root)
    if path.suffix.lower() == pyfg.SUFFIX:
        return _Source("pyfg", path)
    if is_pose_file(path):
        raise InputError(
            f'{log}: is a file of poses, expected a log: name it as odometry or reference in a manifest with reader = "mapped", '
            f"or compare it with a log: `fgloc score {log} LOG`"
        )
    if path.suffix.lower() in TABLES:
        raise InputError(f'{log}: is a table: describe its columns in a manifest with reader = "mapped"')
    raise InputError(f"{log}: is not a manifest (.toml): name the reader of its format with --reader")


def _from_manifest(file: Path, data_root: str | Path | None) -> _Source:
    """Return the source that the manifest in ``file`` describes. ``data_root``: the data folder, by default FGLOC_DATA.

    Raises InputError if the data of the manifest do not exist."""
    manifest = read_manifest(file)
    path = None
    if manifest.path is not None:
        path = named_path(file.parent, manifest.path, file, data_root)
        if not path.exists():
            missing = file if file in manifests().values() else f"{file} (which has no {manifest.path} in its folder)"
            root = find_data_root(data_root, missing)
            raise InputError(f"{file}: its data {manifest.path} does not exist, neither in its folder nor below {root}")
    return _Source(manifest.reader, path, None if file.name == RUN_FILE else file.stem, manifest, file)


def _read(source: _Source, rig: Rig | None, world: World | None, options: Mapping[str, Any], naming: list[str]) -> Log:
    """Read one log from ``source``, check it, and return it.

    ``rig``, ``world``: if given, they replace the rig and the world of the log. ``options``: one value per option.
    ``naming``: the options that are appended to the name of the log to make it unique."""
    chosen, manifest = reader(source.reader), source.manifest
    options = with_wheels_of(rig, options)
    log: Log = chosen.read(source.path, parse_model(chosen.Options, options, f"options of reader {source.reader}"))
    name = "-".join([source.name or log.name, *(f"{key}{options[key]}" for key in naming)])
    metadata = {key: text for key, text in log.metadata.items() if rig is None or key != RIG_NOTES}
    if manifest is not None:
        metadata |= {"title": manifest.title, "licence": manifest.licence, "origin": manifest.origin}
    log = replace(
        log,
        name=name,
        rig=rig or log.rig,
        world=world or log.world,
        start=manifest.start.pose(log.t0_ns) if manifest and manifest.start else log.start,
        metadata=metadata,
    )
    require_bounds(log)
    log = without_false_headings(log)
    if manifest is not None and manifest.markers is not None:
        from factorgraph_loc.sensors.camera.frontend import with_markers  # noqa: PLC0415 - most logs do not need OpenCV

        log = with_markers(log, manifest.markers.family)
    warnings = list(log.warnings)
    if "imu" in log.streams and "imu" not in log.rig.sensors:
        if log.rig.name == DEFAULT_RIG.name:
            log = replace(log, rig=log.rig.model_copy(update={"sensors": (*log.rig.sensors, "imu")}))
        else:
            warnings.append(notice("unused_gyro", "the log has a gyro that is not used: add imu to sensors in the rig"))
    if log.rig.name == DEFAULT_RIG.name:
        sentence = "no rig is given: the default rig lacks this robot's noise and the mounting of its sensors"
        warnings.append(notice("default_rig", sentence))
    log = replace(log, rig=with_wheels_in(log.rig, options))
    return replace(log, warnings=(*warnings, *log_warnings(log)))
