"""The tables of docs/settings.md: what can be set, from the models of the settings."""

from collections.abc import Sequence

from factorgraph_loc.files.settings import Setting, default_text, settings_in, values_text
from factorgraph_loc.fusion import registry
from factorgraph_loc.plugins import ESTIMATORS


def tables() -> list[str]:
    """The lines of all tables, with their headings."""
    lines = ["## Estimators", ""]
    for name in ESTIMATORS.own:
        found = registry.describe(name)
        kinds = " and ".join(word for word, there in (("causal", found.causal), ("smoothed", found.smoothed)) if there)
        lines += [f"### {name}", "", found.about, f"Its estimates are {kinds}; it takes {_names(found.sensors)}.", ""]
        lines += table(settings_in(registry.settings_type(name)))
    return lines[:-1]


def table(settings: Sequence[Setting]) -> list[str]:
    """A table of settings."""
    lines = ["| setting | default | values | what it is |", "|---|---|---|---|"]
    for s in settings:
        lines.append(f"| `{s.key}` | {default_text(s)} | {values_text(s)} | {s.meaning} |")
    return [*lines, ""]


def _names(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
