"""The tables of docs/limits.md, which list the bounds of all columns and settings. They are made from the models of the
settings."""

from pydantic import BaseModel

from factorgraph_loc.files.columns import POINTS, POSES, STAMP
from factorgraph_loc.files.settings import Setting, bound_text, settings_in
from factorgraph_loc.fusion import registry
from factorgraph_loc.io.readers.manifests import StartSettings
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.sensors.tables import all_tables
from factorgraph_loc.simulation.settings import SimulationSettings

FILES: dict[str, type[BaseModel]] = {
    "`NAME.world.toml`": World,
    "`[start]`": StartSettings,
}
ESTIMATORS: dict[str, type[BaseModel]] = {
    f"settings of {name}": registry.settings_type(name) for name in registry.ESTIMATORS
}
# docs/settings.md has the bounds of these settings, and of those of the estimators
OTHERS: dict[str, type[BaseModel]] = {
    "`NAME.rig.toml`": Rig,
    "settings of simulations": SimulationSettings,
    "settings of active robots": ActiveSettings,
}


def numbers_of(model: type[BaseModel]) -> list[Setting]:
    """Return the settings of a model whose values are numbers."""
    return [setting for setting in settings_in(model) if "number" in setting.kind]


def tables() -> list[str]:
    """Return the lines of all tables, with their headings."""
    lines = [
        "### Columns",
        "",
        f"`t_ns` of every table is the {STAMP.doc}, from {bound_text(STAMP.low)} to {bound_text(STAMP.high)} ns.",
        "",
    ]
    lines += [*_columns(), "", "### Settings", ""]
    for name, model in FILES.items():
        lines += [f"**{name[0].upper()}{name[1:]}**", "", "| key | least | most |", "|---|---|---|"]
        keys: dict[str, list[str]] = {}
        for s in numbers_of(model):
            keys.setdefault(f"{bound_text(s.low)} | {bound_text(s.high)}", []).append(f"`{s.key}`")
        lines += [f"| {', '.join(these)} | {bounds} |" for bounds, these in keys.items()]
        lines.append("")
    return lines[:-1]


def _columns() -> list[str]:
    """Return the lines of the table of all columns. Columns that differ only in their name, or only in their table, are one row."""
    tables: dict[tuple[str, ...], dict[str, None]] = {}
    for table in (*all_tables(), POSES, POINTS):
        for column in (c for c in table.columns if c.name != STAMP.name):
            unit = next(iter(column.units), "")
            low, high = (bound_text(column.low), bound_text(column.high)) if column.units else ("", "")
            row = (column.name, "" if unit == "1" else unit, low, high, "yes" if column.may_lack else "", column.doc)
            tables.setdefault(row, {})[table.name] = None
    names: dict[tuple[str, ...], list[str]] = {}
    for (name, *row), of in tables.items():
        names.setdefault((", ".join(of), *row), []).append(f"`{name}`")
    heads = ["column", "of", "unit", "least", "most", "may be empty", "what it is"]
    rows = [heads, *([", ".join(these), *row] for row, these in names.items())]
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return [lines[0], "|" + "---|" * len(heads), *lines[1:]]
