"""The tables of docs/settings.md: what can be set, from the models of the settings."""

from collections.abc import Iterable, Sequence

from factorgraph_loc.api.lookups import describe_preset, known_policies
from factorgraph_loc.files.settings import Setting, default_text, settings_in, values_text
from factorgraph_loc.fusion import registry
from factorgraph_loc.io.readers import reader
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS
from factorgraph_loc.sensors.registry import about, sections_of, sensor


def tables() -> list[str]:
    """The lines of all tables, with their headings."""
    return [*_estimators(), *_rig(), *_readers(), *_simulations(), *_active()][:-1]


def _estimators() -> list[str]:
    lines = ["## Estimators", ""]
    for name in ESTIMATORS.own:
        found = registry.describe(name)
        kinds = " and ".join(word for word, there in (("causal", found.causal), ("smoothed", found.smoothed)) if there)
        lines += [f"### {name}", "", found.about, f"Its estimates are {kinds}; it takes {_names(found.sensors)}.", ""]
        lines += _table(settings_in(registry.settings_type(name)))
    return lines


def _rig() -> list[str]:
    top = [setting for setting in settings_in(Rig) if "." not in setting.key and setting.kind == "text"]
    lines = ["## Rig", "", *_table(top)]
    for name in SENSORS.own:
        for section, settings in sections_of(sensor(name)).items():
            lines += [f"### [{section}]", "", f"A section of the sensor `{name}`. {about(name)}", "", *_table(settings)]
    return lines


def _readers() -> list[str]:
    lines = ["## Options of readers", ""]
    for name in READERS.own:
        options = settings_in(reader(name).options)
        lines += [f"### {name}", "", reader(name).about, "", *(_by_table(options) if options else ["No options.", ""])]
    return lines


def _by_table(settings: Sequence[Setting]) -> list[str]:
    """A table of settings, in which those of several tables that differ in nothing but the table are one row."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for s in settings:
        table, _, key = s.key.removesuffix(".*").rpartition(".")
        key += s.key[len(f"{table}.{key}" if table else key) :]
        rows.setdefault((key, default_text(s), values_text(s), s.meaning), []).append(table)
    lines = ["| setting | of | default | values | what it is |", "|---|---|---|---|---|"]
    return [
        *lines,
        *(f"| `{k}` | {_names(filter(None, tables))} | {d} | {v} | {m} |" for (k, d, v, m), tables in rows.items()),
        "",
    ]


def _simulations() -> list[str]:
    settings = [s for s in describe_preset("office").settings if s.key != "name"]
    told = "The values are those of the preset `office`; `fgloc presets NAME` prints those of another one."
    return ["## Simulated logs", "", told, "", *_table(settings)]


def _active() -> list[str]:
    return ["## Active robots", "", *_table(known_policies()[0].settings)]


def _table(settings: Sequence[Setting]) -> list[str]:
    """A table of settings."""
    lines = ["| setting | default | values | what it is |", "|---|---|---|---|"]
    for s in settings:
        lines.append(f"| `{s.key}` | {default_text(s)} | {values_text(s)} | {s.meaning} |")
    return [*lines, ""]


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
