"""Shell completion of names and settings. It must be fast, so no numerical libraries may be imported here."""

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from factorgraph_loc.files.shipped import manifests, rigs
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS

# repeated here, because the module that defines them is slow to import; a test compares them
PRESETS = ("office", "sparse", "bursty", "corridor", "warehouse", "symmetric")
POLICIES = ("information", "paper_literal", "random", "patrol", "nearest_tags")
ACTIVE_ESTIMATORS = ("active_mcl", "particle_filter", "smoother")
NO_SETTINGS = ("FileModel", "Rig", "Annotated", "Literal", "Field", "InUnit", "Any", "Mapping")  # of other modules
PRIORS = ("reference", "log", "unknown")


def logs(incomplete: str) -> list[str]:
    """Names that `fgloc datasets` lists; without a match the shell completes file names."""
    return [name for name in manifests() if name.startswith(incomplete)]


def estimator(incomplete: str) -> list[str]:
    """An estimator's name."""
    return [name for name in ESTIMATORS if name.startswith(incomplete)]


def estimators(incomplete: str) -> list[str]:
    """Comma-separated names of estimators: completes the last one, without repetition."""
    return _last(incomplete, ESTIMATORS)


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
    return _last(incomplete, [channel.name for sensor in SENSORS.values() for channel in sensor.channels])


def sensor(incomplete: str) -> list[str]:
    """The name of a sensor."""
    return [name for name in SENSORS if name.startswith(incomplete)]


def rig(incomplete: str) -> list[str]:
    """The name of a rig; without a match the shell completes file names."""
    return [name for name in ("default", *rigs(), *PRESETS) if name.startswith(incomplete)]


def reader(incomplete: str) -> list[str]:
    """The name of a reader."""
    return [name for name in READERS if name.startswith(incomplete)]


def simulation_setting(incomplete: str) -> list[str]:
    """The name of a setting KEY=VALUE of a simulation."""
    return [f"{key}=" for key in simulation_settings() if key.startswith(incomplete)]


def active_setting(incomplete: str) -> list[str]:
    """The name of a setting KEY=VALUE of an active run, or of its world."""
    keys = (*_keys("factorgraph_loc.planning.settings", "ActiveSettings"), *simulation_settings())
    return [f"{key}=" for key in keys if key.startswith(incomplete)]


def policies(incomplete: str) -> list[str]:
    """Comma-separated names of policies: completes the last one, without repetition."""
    return _last(incomplete, POLICIES)


def active_estimators(incomplete: str) -> list[str]:
    """Comma-separated names of estimators of active robots: completes the last one, without repetition."""
    return _last(incomplete, ACTIVE_ESTIMATORS)


def simulation_settings() -> list[str]:
    """The keys of a simulation's settings with dots, those of its sensors included, but not those of its rig."""
    own = _keys("factorgraph_loc.simulation.settings", "SimulationSettings")
    sections = {name: section.kind for sensor in SENSORS.values() for name, section in sensor.simulation.items()}
    told = [f"{name}.{key}" for name, kind in sections.items() for key in _keys(*kind.split(":"))]
    return [*(key for key in own if key != "rig"), *told]


def settings_of(name: str) -> list[str]:
    """The keys of an estimator's settings, as their source has them: to import it takes seconds."""
    if name not in ESTIMATORS:
        return []
    module, _, kind = ESTIMATORS.place(name).partition(":")
    return list(dict(_fields(module, f"{kind}Settings")))


def _last(incomplete: str, names: Iterable[str]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    there = before.split(",")
    return [f"{before}{comma}{name}" for name in names if name.startswith(last) and name not in there]


def _keys(module: str, kind: str) -> list[str]:
    """The keys of a model with dots: those of the models of the same module in it, too."""
    keys = []
    for name, annotation in dict(_fields(module, kind)).items():
        models = [part.id for part in ast.walk(annotation) if isinstance(part, ast.Name) and part.id[0].isupper()]
        nested = [f"{name}.{key}" for model in models for key in _keys(module, model)]
        keys += nested or [name]
    return keys


@cache
def _parsed(module: str) -> list[ast.stmt]:
    """The statements of a module, which is not imported, nor are the packages that it is in; none if there is no source."""
    top, *below = module.split(".")
    for place in (spec.submodule_search_locations or ()) if (spec := find_spec(top)) else ():
        path = Path(place, *below)
        for file in (path.with_name(f"{path.name}.py"), path / "__init__.py"):
            if file.is_file():
                return ast.parse(file.read_text("utf-8")).body
    return []


def _fields(module: str, kind: str) -> Iterator[tuple[str, ast.expr]]:
    """The fields of a model with their annotations: those of its bases, then its own."""
    for node in _parsed(module):
        match node:
            case ast.ClassDef(name=name, bases=bases, body=body) if name == kind:
                for base in bases:
                    yield from _fields(module, ast.unparse(base))
                fields = [line for line in body if isinstance(line, ast.AnnAssign)]
                told = [(ast.unparse(f.target), f.annotation) for f in fields]
                yield from ((name, kind) for name, kind in told if "ClassVar" not in ast.unparse(kind))
            case ast.ImportFrom(module=str(other), names=names, level=0) if kind in [name.name for name in names]:
                yield from _fields(other, kind) if kind not in NO_SETTINGS else ()
