"""Shell completion of names and settings. It must be fast, so no numerical libraries may be imported here."""

import ast
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from factorgraph_loc.files.shipped import manifests, rigs
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS

# repeated here, because the module that defines them is slow to import; a test compares them
PRESETS = ("office", "sparse", "bursty", "corridor", "warehouse", "symmetric")
PRIORS = ("reference", "log", "unknown")


def logs(incomplete: str) -> list[str]:
    """Names that `fgloc datasets` lists; without a match the shell completes file names."""
    return [name for name in manifests() if name.startswith(incomplete)]


def estimator(incomplete: str) -> list[str]:
    """An estimator's name."""
    return [name for name in ESTIMATORS if name.startswith(incomplete)]


def estimators(incomplete: str) -> list[str]:
    """Comma-separated names of estimators: completes the last one, without repetition."""
    before, comma, last = incomplete.rpartition(",")
    there = before.split(",")
    return [f"{before}{comma}{name}" for name in estimator(last) if name not in there]


def preset(incomplete: str) -> list[str]:
    """A simulation preset."""
    return [name for name in PRESETS if name.startswith(incomplete)]


def prior(incomplete: str) -> list[str]:
    """A keyword for the start of a run."""
    return [name for name in PRIORS if name.startswith(incomplete)]


def setting(incomplete: str) -> list[str]:
    """The name of a setting NAME.KEY=VALUE: that of the estimator first, then the key."""
    name, dot, key = incomplete.partition(".")
    if not dot:
        return [f"{one}." for one in estimator(name)]
    return [f"{name}.{one}=" for one in settings_of(name) if one.startswith(key)]


def sensors(incomplete: str) -> list[str]:
    """Comma-separated names of sensors: completes the last one, without repetition."""
    before, comma, last = incomplete.rpartition(",")
    there = before.split(",")
    names = [channel.name for sensor in SENSORS.values() for channel in sensor.channels]
    return [f"{before}{comma}{name}" for name in names if name.startswith(last) and name not in there]


def sensor(incomplete: str) -> list[str]:
    """The name of a sensor."""
    return [name for name in SENSORS if name.startswith(incomplete)]


def rig(incomplete: str) -> list[str]:
    """The name of a rig; without a match the shell completes file names."""
    return [name for name in ("default", *rigs(), *PRESETS) if name.startswith(incomplete)]


def reader(incomplete: str) -> list[str]:
    """The name of a reader."""
    return [name for name in READERS if name.startswith(incomplete)]


def settings_of(name: str) -> list[str]:
    """The keys of an estimator's settings, as their source has them: to import it takes seconds."""
    if name not in ESTIMATORS:
        return []
    module, _, kind = ESTIMATORS.place(name).partition(":")
    return list(dict.fromkeys(_fields(module, f"{kind}Settings")))


def _fields(module: str, kind: str) -> Iterator[str]:
    """The fields of a model: those of its bases, then its own."""
    spec = find_spec(module)
    for node in ast.parse(Path(spec.origin).read_text("utf-8")).body if spec and spec.origin else ():
        match node:
            case ast.ClassDef(name=name, bases=bases, body=body) if name == kind:
                for base in bases:
                    yield from _fields(module, ast.unparse(base))
                fields = [line for line in body if isinstance(line, ast.AnnAssign)]
                yield from (ast.unparse(f.target) for f in fields if "ClassVar" not in ast.unparse(f.annotation))
            case ast.ImportFrom(module=str(other), names=names, level=0) if kind in [name.name for name in names]:
                yield from _fields(other, kind) if kind != "FileModel" else ()
