"""The tables of docs/limits.md: the bounds of all columns and settings, from their descriptions."""

import math
from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel

from factorgraph_loc.files.columns import POINTS, POSES, Table
from factorgraph_loc.files.models import bounds
from factorgraph_loc.fusion import registry
from factorgraph_loc.io.readers.manifests import StartSettings
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.sensors.tables import all_tables
from factorgraph_loc.simulation.settings import SimulationSettings

FILES: dict[str, type[BaseModel]] = {
    "`NAME.rig.toml`": Rig,
    "`NAME.world.toml`": World,
    "`[start]`": StartSettings,
    "settings of simulations": SimulationSettings,
    "settings of active robots": ActiveSettings,
    **{f"settings of {name}": registry.settings_type(name) for name in registry.ESTIMATORS},
}
Number = tuple[str, type, float, float]


def numbers_of(model: type[BaseModel], prefix: str = "") -> list[Number]:
    """Key, kind and bounds of all numbers in settings; ``*`` stands for a user-defined name."""
    found: dict[str, Number] = {}
    for name, field in model.model_fields.items():
        for number in _numbers(field.annotation, tuple(field.metadata), f"{prefix}{name}"):
            found.setdefault(number[0], number)
    return list(found.values())


def _numbers(annotation: Any, metadata: tuple[Any, ...], key: str) -> Iterator[Number]:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _numbers(arguments[0], (*metadata, *arguments[1:]), key)
    elif annotation in (int, float):
        yield key, annotation, *bounds(metadata)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield from numbers_of(annotation, f"{key}.")
    elif origin is dict:
        yield from _numbers(arguments[1], (), f"{key}.*")
    elif origin in (Union, UnionType):
        for argument in arguments:
            yield from _numbers(argument, metadata, key)
    elif origin in (tuple, list):
        for argument in arguments:
            yield from _numbers(argument, (), key)


def tables() -> list[str]:
    """The lines of all tables, with their headings."""
    lines = ["### Columns", ""]
    for table in (*all_tables(), POSES, POINTS):
        lines += [*_of_columns(table), ""]
    lines += ["### Settings", ""]
    for name, model in FILES.items():
        lines += [f"**{name[0].upper()}{name[1:]}**", "", "| key | least | most |", "|---|---|---|"]
        told = [
            number for number in numbers_of(model) if not number[0].startswith("rig.")
        ]  # those of the rig's own file
        lines += [f"| `{key}` | {written(low)} | {written(high)} |" for key, _, low, high in told]
        lines.append("")
    return lines[:-1]


def _of_columns(table: Table) -> list[str]:
    names = ", ".join(f"`{column.name}`" for column in table.columns if column.kind not in ("stamp", "name", "file"))
    lines = [f"**`{table.name}`**" + (f" with {names}" if names else ""), ""]
    lines += ["| column | unit | least | most | may be empty | what it is |", "|---|---|---|---|---|---|"]
    for column in table.columns:
        unit = next(iter(column.units), "")
        low, high = (written(column.low), written(column.high)) if column.units else ("", "")
        lack = "yes" if column.may_lack else ""
        lines.append(f"| `{column.name}` | {'' if unit == '1' else unit} | {low} | {high} | {lack} | {column.doc} |")
    return lines


def written(value: float) -> str:
    """A bound in readable form: as a multiple of pi, or rounded."""
    for times, name in ((2.0, "2 pi"), (1.0, "pi"), (0.5, "pi / 2")):
        if math.isclose(abs(value), times * math.pi, rel_tol=1e-12):
            return name if value > 0.0 else f"-{name}"
    if 0.0 < abs(value) < 1e-300:
        return "above 0"
    return f"{value:.6g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")
