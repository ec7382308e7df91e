"""The logs of files in any format, each read by a module with a model of ``Options`` and a function ``read(path, options)``."""

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import kind
from factorgraph_loc.files.column_mapping import JSON_SUFFIXES
from factorgraph_loc.files.data_root import EXPECTED, RUN_FILE, find_data_root, named_path
from factorgraph_loc.files.models import FileModel, nearest, parse_model, read_toml
from factorgraph_loc.files.settings import first_sentence
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.io.bags.file import is_bag, require_metadata
from factorgraph_loc.io.checks import look_over, require_bounds
from factorgraph_loc.io.motions import with_wheels_in, with_wheels_of
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, read_rig
from factorgraph_loc.io.native.world_file import read_world
from factorgraph_loc.io.readers.manifests import Manifest, read_manifest
from factorgraph_loc.io.readers.pose_file import is_pose_file
from factorgraph_loc.model.log import RIG_NOTES, Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import READERS
from factorgraph_loc.text import listed, one_line, quoted

LogLike = Log | str | Path
RigLike = Rig | str | Path
WorldLike = World | str | Path
MOST = 1000  # maximum number of logs from lists of options
TABLES = (".csv", *JSON_SUFFIXES)


@dataclass(frozen=True)
class Reader:
    """A reader: the model of its options, ``read(path, options)``, which returns the log, and one sentence ``about`` its format."""

    options: type[FileModel]
    read: Callable[[Path | None, Any], Log]
    about: str


def reader(name: str) -> Reader:
    """The reader of a format; InputError with the most similar name if it is unknown."""
    if name not in READERS:
        raise InputError(f"there is no reader {quoted(name)}{nearest(name, list(READERS))}")
    module = READERS[name]
    return Reader(module.Options, module.read, first_sentence(module))


@dataclass(frozen=True)
class _Source:
    """A reader, its input, and additions to its log; ``name``: None for the reader's name."""

    reader: str
    path: Path | None
    name: str | None = None
    rig: Rig | None = None
    world: World | None = None
    manifest: Manifest | None = None


def load(
    log: LogLike,
    *,
    data_root: str | Path | None = None,
    reader: str | None = None,
    options: Mapping[str, Any] | None = None,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
) -> list[Log]:
    """The logs that ``log`` refers to.

    ``log``: a manifest, a folder in the native format or its ``run.toml``, a name in ``manifests()``, any path with ``reader``, or
    a log. ``options``: of the reader, overriding those of a manifest; a list, or text with commas, gives one log per value. ``rig``
    and ``world``, values or files, replace those of the log. ``data_root``: a folder that a manifest may lead to besides its own,
    by default the environment's FGLOC_DATA. InputError describes what is invalid in one line.
    """
    new_rig = read_rig(rig) if isinstance(rig, str | Path) else rig
    new_world = read_world(world) if isinstance(world, str | Path) else world
    if isinstance(log, Log):
        return [replace(log, rig=new_rig or log.rig, world=new_world or log.world)]
    given = dict(options or {})
    given_files = [what for what, file in (("rig", rig), ("world", world)) if file is not None]
    source = _find(str(log), data_root, reader, given_files)
    described = source.manifest.options if source.manifest else {}
    choices = {key: _choices(value) for key, value in described.items()}
    # lists are given as text with commas on the command line
    choices |= {
        key: [part.strip() for part in value.split(",")] if isinstance(value, str) else _choices(value)
        for key, value in given.items()
    }
    if (count := math.prod(map(len, choices.values()))) > MOST:
        raise InputError(f"{log}: its options give {count:,} logs, expected at most {MOST:,}")
    if empty := [key for key, values in choices.items() if not values]:
        raise InputError(f"{log}: option {empty[0]} is an empty list, expected a value or several")
    naming = [
        key
        for key, values in choices.items()
        if (key in given or len(values) > 1) and not any(isinstance(value, Mapping) for value in values)
    ]
    replaced = replace(source, rig=new_rig or source.rig, world=new_world or source.world)
    return [
        _read(replaced, dict(zip(choices, values, strict=True)), naming)
        for values in itertools.product(*choices.values())
    ]


def load_all(
    logs: LogLike | Sequence[LogLike], rig: RigLike | None = None, world: WorldLike | None = None
) -> list[Log]:
    """The logs that one or several values refer to, as in :func:`load`."""
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
    """The log that ``log`` refers to, as in :func:`load`; InputError if there are several."""
    logs = load(log, data_root=data_root, reader=reader, options=options, rig=rig, world=world)
    if len(logs) > 1:
        raise InputError(f"{log} refers to {len(logs)} logs, expected one: {listed(loaded.name for loaded in logs)}")
    return logs[0]


def _choices(value: Any) -> list[Any]:
    """The values of an option, which may be a list."""
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _find(log: str, data_root: str | Path | None, named: str | None, given: Collection[str]) -> _Source:
    path = Path(log)
    if named is not None:
        reader(named)  # report a wrong reader before a wrong path
    if kind(path) not in ("", "a file", "a folder"):
        raise InputError(f"{log}: is {kind(path)}, expected a file or a folder")
    if named is not None:
        if not path.exists():
            raise InputError(f"{log}: does not exist")
        return _Source(named, path, None if named == "native" else _name(path))
    if path.is_dir() and (path / RUN_FILE).is_file():
        path /= RUN_FILE
    if path.exists() and is_bag(path):
        raise InputError(f"{log}: is a ROS bag: `fgloc manifest {log} > run.toml` proposes how to read it")
    if path.is_file():
        return _from_file(log, path, data_root, given)
    known = manifests()
    if log in known:
        return _from_manifest(known[log], data_root, given)
    if path.is_dir():
        require_metadata(path)
        raise InputError(f"{log}: has no {RUN_FILE}, so it is not in the native format; name the reader of its format")
    raise InputError(f"{log}: is neither a file, nor a folder, nor a known data set{nearest(log, list(known))}")


def _from_file(log: str, path: Path, data_root: str | Path | None, given: Collection[str]) -> _Source:
    if path.name == RUN_FILE and "reader" not in read_toml(path):  # a manifest may have this name too
        return _Source("native", path.parent)
    if path.suffix == ".toml":
        return _from_manifest(path, data_root, given)
    if is_pose_file(path):
        raise InputError(
            f"{log}: is a file of poses, expected a log: name it as odometry or reference in a manifest with the reader mapped, "
            f"or compare it with a log: `fgloc score {log} LOG`"
        )
    if path.suffix.lower() in TABLES:
        raise InputError(f"{log}: is a table: describe its columns in a manifest with the reader mapped")
    raise InputError(f"{log}: is not a manifest (.toml); name the reader of this format")


def _name(path: Path) -> str:
    return path.resolve().stem if path.is_file() else path.resolve().name


def _from_manifest(file: Path, data_root: str | Path | None, given: Collection[str]) -> _Source:
    """The source that a manifest describes, without its ``rig`` and ``world`` if these are among the ``given`` replacements."""
    manifest: Manifest = read_manifest(file)
    path = None
    if manifest.path is not None:
        path = named_path(file.parent, manifest.path, file, data_root)
        if not path.exists():
            missing = file if file in manifests().values() else f"{file} (which has no {manifest.path} in its folder)"
            root = find_data_root(data_root, missing)
            raise InputError(f"{file}: its data {manifest.path} does not exist, neither in its folder nor below {root}")
    named = {what: name for what, name in (("rig", manifest.rig), ("world", manifest.world)) if what not in given}
    files = {
        what: named_path(file.parent, name, file, data_root, f"{EXPECTED}; or `--{what} FILE` in its place")
        for what, name in named.items()
        if name is not None
    }
    return _Source(
        manifest.reader,
        path,
        None if file.name == RUN_FILE else file.stem,
        read_rig(files["rig"]) if "rig" in files else None,
        read_world(files["world"]) if "world" in files else None,
        manifest,
    )


def _read(source: _Source, options: Mapping[str, Any], naming: list[str]) -> Log:
    """One log; ``naming``: options that are appended to its name to make it unique."""
    chosen, manifest = reader(source.reader), source.manifest
    options = with_wheels_of(source.rig, options)
    log = chosen.read(source.path, parse_model(chosen.options, options, f"options of reader {source.reader}"))
    name = "-".join([source.name or log.name, *(f"{key}{options[key]}" for key in naming)])
    metadata = {key: text for key, text in log.metadata.items() if source.rig is None or key != RIG_NOTES}
    if manifest is not None:
        metadata |= {"title": manifest.title, "licence": manifest.licence, "origin": manifest.origin}
    log = replace(
        log,
        name=name,
        rig=source.rig or log.rig,
        world=source.world or log.world,
        start=manifest.start.pose(log.t0_ns) if manifest and manifest.start else log.start,
        metadata=metadata,
    )
    require_bounds(log)
    if manifest is not None and manifest.markers is not None:
        from factorgraph_loc.sensors.camera.frontend import with_markers  # noqa: PLC0415 - most logs do not need OpenCV

        log = with_markers(log, manifest.markers.family)
    warnings = list(log.warnings)
    if "imu" in log.streams and "imu" not in log.rig.sensors:
        if log.rig is DEFAULT_RIG:
            log = replace(log, rig=log.rig.model_copy(update={"sensors": (*log.rig.sensors, "imu")}))
        else:
            warnings.append("the gyro is not used, because the rig's sensors do not include imu")
    if log.rig.name == DEFAULT_RIG.name:
        warnings.append("no rig is given: the default rig does not have this robot's noise and mounting")
    log = replace(log, rig=with_wheels_in(log.rig, options))
    return replace(log, warnings=tuple(map(one_line, (*warnings, *look_over(log)))))
