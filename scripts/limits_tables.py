"""The tables of docs/limits.md: the bounds of all columns and settings, from their descriptions."""

from pydantic import BaseModel

from factorgraph_loc.files.columns import POINTS, POSES, STAMP, Table
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
# the page of settings has the bounds of these, and of the estimators
OTHERS: dict[str, type[BaseModel]] = {
    "`NAME.rig.toml`": Rig,
    "settings of simulations": SimulationSettings,
    "settings of active robots": ActiveSettings,
}


def numbers_of(model: type[BaseModel]) -> list[Setting]:
    """All numbers in settings."""
    return [setting for setting in settings_in(model) if "number" in setting.kind]


def tables() -> list[str]:
    """The lines of all tables, with their headings."""
    lines = [
        "### Columns",
        "",
        f"`t_ns` of every table is the {STAMP.doc}, from {bound_text(STAMP.low)} to {bound_text(STAMP.high)} ns.",
        "",
    ]
    for table in (*all_tables(), POSES, POINTS):
        lines += [*_of_columns(table), ""]
    lines += ["### Settings", ""]
    for name, model in FILES.items():
        lines += [f"**{name[0].upper()}{name[1:]}**", "", "| key | least | most |", "|---|---|---|"]
        lines += [f"| `{s.key}` | {bound_text(s.low)} | {bound_text(s.high)} |" for s in numbers_of(model)]
        lines.append("")
    return lines[:-1]


def _of_columns(table: Table) -> list[str]:
    lines = [
        f"**`{table.name}`**",
        "",
        "| column | unit | least | most | may be empty | what it is |",
        "|---|---|---|---|---|---|",
    ]
    for column in (c for c in table.columns if c.name != STAMP.name):
        unit = next(iter(column.units), "")
        low, high = (bound_text(column.low), bound_text(column.high)) if column.units else ("", "")
        lack = "yes" if column.may_lack else ""
        lines.append(f"| `{column.name}` | {'' if unit == '1' else unit} | {low} | {high} | {lack} | {column.doc} |")
    return lines
