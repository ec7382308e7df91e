"""Shell completion of names and settings.

Completion of names is fast, because it imports no numerical library. Completion of settings imports the classes that
define the settings, which takes a second.
"""

from collections.abc import Callable, Iterable

from factorgraph_loc.files.shipped import manifests, rigs
from factorgraph_loc.model.scoring import NAMED_PRIORS
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS, ESTIMATORS, MAP_ESTIMATORS, POLICIES, PRESETS, READERS, SENSORS

Completion = Callable[[str], list[str]]


def _one_of(names: Callable[[], Iterable[str]]) -> Completion:
    """Return a function that completes a name for the shell. ``names`` is called to get all valid names."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _some_of(names: Callable[[], Iterable[str]]) -> Completion:
    """Return a function that completes the last name in a comma-separated list, except names already in the list.

    ``names`` is called to get all valid names."""

    def complete(incomplete: str) -> list[str]:
        first, comma, last = incomplete.rpartition(",")
        chosen = first.split(",")
        return [f"{first}{comma}{name}" for name in names() if name.startswith(last) and name not in chosen]

    return complete


logs = _one_of(manifests)  # if no manifest matches, the shell completes file names
estimator = _one_of(lambda: ESTIMATORS)
estimators = _some_of(lambda: ESTIMATORS)
preset = _one_of(lambda: PRESETS)
prior = _one_of(lambda: NAMED_PRIORS)
sensor = _one_of(lambda: SENSORS)
sensors = _some_of(lambda: [channel.name for sensor in SENSORS.values() for channel in sensor.channels])
rig = _one_of(lambda: ("default", *rigs(), *PRESETS))
reader = _one_of(lambda: READERS)
policies = _some_of(lambda: POLICIES)
active_estimators = _some_of(lambda: ACTIVE_ESTIMATORS)
map_estimator = _one_of(lambda: MAP_ESTIMATORS)


def setting(incomplete: str) -> list[str]:
    """Return completions of an option NAME.KEY=VALUE: "NAME.", or "NAME.KEY=" if ``incomplete`` has a dot."""
    name, dot, _ = incomplete.partition(".")
    if not dot:
        return [f"{known}." for known in estimator(name)]
    if name not in ESTIMATORS:
        return []
    from factorgraph_loc.files.settings import settings_in
    from factorgraph_loc.fusion.registry import settings_type

    return [f"{s.key}=" for s in settings_in(settings_type(name), f"{name}.") if s.key.startswith(incomplete)]


def simulation_setting(incomplete: str) -> list[str]:
    """Return the completions "KEY=" of a setting KEY=VALUE of a simulation. Keys ``rig.KEY`` are not proposed."""
    from factorgraph_loc.files.settings import settings_in
    from factorgraph_loc.simulation import SimulationSettings

    keys = [s.key for s in settings_in(SimulationSettings) if not s.key.startswith("rig.")]
    return [f"{key}=" for key in keys if key.startswith(incomplete)]


def active_setting(incomplete: str) -> list[str]:
    """Return the completions "KEY=" of a setting KEY=VALUE of ``fgloc active``."""
    from factorgraph_loc.files.settings import settings_in
    from factorgraph_loc.planning.settings import ActiveSettings

    own = [f"{s.key}=" for s in settings_in(ActiveSettings) if s.key.startswith(incomplete)]
    return [*own, *simulation_setting(incomplete)]
