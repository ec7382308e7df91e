"""The tables of docs/settings.md, which list all settings. They are made from the models of the settings."""

from collections.abc import Iterable, Sequence

from factorgraph_loc.api.lookups import describe_preset, known_policies
from factorgraph_loc.files.settings import TABLE, Setting, default_text, settings_in, values_text
from factorgraph_loc.fusion import registry
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.plugins import ESTIMATORS, SENSORS
from factorgraph_loc.sensors.registry import about, sections_of, sensor


def tables() -> list[str]:
    """Return the lines of all tables, with their headings."""
    return [*_estimators(), *_rig(), *_simulations(), *_active()][:-1]


def _estimators() -> list[str]:
    settings = [(s.key, name, s) for name in ESTIMATORS.own for s in settings_in(registry.settings_type(name))]
    return ["## Estimators", "", *_table(settings, owned=True)]


def _rig() -> list[str]:
    top = [setting for setting in settings_in(Rig) if "." not in setting.key and setting.kind == "text"]
    lines = ["## Rig", "", *_own(top)]
    for name in SENSORS.own:
        for i, (section, settings) in enumerate(sections_of(sensor(name)).items()):
            what = f"A section of the sensor `{name}`." + ("" if i else f" {about(name)}")
            lines += [f"### [{section}]", "", what, "", *_own(settings)]
    return lines


def _simulations() -> list[str]:
    settings = [s for s in describe_preset("office").settings if s.key != "name"]
    text = "The values are those of the preset `office`; `fgloc presets NAME` prints those of another one."
    return ["## Simulated logs", "", text, "", *_own(settings)]


def _active() -> list[str]:
    return ["## Active robots", "", *_own(known_policies()[0].settings)]


def _own(settings: Sequence[Setting]) -> list[str]:
    """Return the table of the settings of one section. A setting that is a table itself is left out if its keys are listed."""
    listed = {s.key.rpartition(".")[0] for s in settings}
    return _table((s.key, "", s) for s in settings if s.kind != TABLE or s.key not in listed)


def _table(settings: Iterable[tuple[str, str, Setting]], *, owned: bool = False) -> list[str]:
    """Return a table of settings, each given with its key and its owner (an estimator). Settings that differ only in the owner,
    or only in the key, are one row. ``owned``: with a column of owners."""
    owners: dict[tuple[str, ...], list[str]] = {}
    for key, owner, s in settings:
        owners.setdefault((key, default_text(s), values_text(s), s.meaning), []).append(owner)
    keys: dict[tuple[str, ...], list[str]] = {}
    for (key, *rest), of in owners.items():
        keys.setdefault((_names(filter(None, of)), *rest), []).append(key)
    heads = ["setting", "of", "default", "values", "what it is"]
    rows = [heads, *([_names(key), *rest] for rest, key in keys.items())]
    shown = [cells if owned else [cells[0], *cells[2:]] for cells in rows]
    lines = [f"| {' | '.join(cells)} |" for cells in shown]
    return [lines[0], "|" + "---|" * len(shown[0]), *lines[1:], ""]


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
