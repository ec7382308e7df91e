"""``fgloc estimators``, ``fgloc sensors`` and ``fgloc readers``: what there is to choose from, and its settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS

if TYPE_CHECKING:
    from factorgraph_loc.files.columns import Column
    from factorgraph_loc.files.settings import Setting
    from factorgraph_loc.fusion.registry import Description
    from factorgraph_loc.sensors.registry import SensorType


def estimators(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Print the settings of this one.", autocompletion=completion.estimator),
    ] = None,
    json: Json = False,
) -> None:
    """List the estimators, or the settings of one."""
    from factorgraph_loc.files.settings import settings_in
    from factorgraph_loc.fusion.registry import describe, settings_type

    if name is not None:
        found = describe(name)
        settings = settings_in(settings_type(name))
        if json:
            show.document({**asdict(found), "settings": settings})
            return
        about = {"estimator": name, "what it is": found.about, "estimates": _estimates(found)}
        show.fields(about | {"sensors": ", ".join(found.sensors)})
        show.line()
        _print_settings(settings)
        if settings:
            show.line()
            show.line(f"to change one: fgloc run LOG -e {name} --set {name}.{settings[0].key}=VALUE")
        return
    known = [describe(one) for one in ESTIMATORS]
    if json:
        show.document(known)
        return
    rows = [(one.name, _estimates(one), one.about, ", ".join(one.sensors)) for one in known]
    show.table(("name", "estimates", "what it is", "sensors"), rows, wrapped=("what it is", "sensors"))


def readers(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Print the options of this one.", autocompletion=completion.reader),
    ] = None,
    json: Json = False,
) -> None:
    """List the readers of logs, or the options of one."""
    from factorgraph_loc.files.settings import settings_in
    from factorgraph_loc.io.readers import reader

    if name is not None:
        found = reader(name)
        options = settings_in(found.options)
        if json:
            show.document({"name": name, "about": found.about, "options": options})
            return
        show.fields({"reader": name, "format": found.about})
        show.line()
        _print_settings(options, "option")
        if options:
            show.line()
            show.line("options are in [options] of a manifest, or --reader-option KEY=VALUE")
        return
    known = {one: reader(one).about for one in READERS}
    if json:
        show.document([{"name": one, "about": about} for one, about in known.items()])
    else:
        show.table(("name", "format"), list(known.items()), wrapped=("format",))


def sensors(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Print the tables and settings of this one.", autocompletion=completion.sensor
        ),
    ] = None,
    json: Json = False,
) -> None:
    """List the sensors, or the tables and the rig's settings of one."""
    from factorgraph_loc.sensors.registry import about
    from factorgraph_loc.sensors.registry import sensor as registered

    if name is not None:
        sensor = registered(name)
        if json:
            show.document(_document(sensor))
        else:
            _print_sensor(sensor)
        return
    known = [registered(one) for one in SENSORS]
    if json:
        show.document([_summary(sensor) for sensor in known])
        return
    rows = [(s.name, about(s.name), ", ".join(c.name for c in s.channels), _sections(s)) for s in known]
    show.table(("name", "what it is", "--sensors", "rig"), rows, wrapped=("what it is", "--sensors"))


def _summary(sensor: SensorType) -> dict[str, Any]:
    from factorgraph_loc.sensors.registry import about

    channels = [channel.name for channel in sensor.channels]
    return {"name": sensor.name, "about": about(sensor.name), "channels": channels, "rig": list(sensor.settings)}


def _document(sensor: SensorType) -> dict[str, Any]:
    from factorgraph_loc.sensors.registry import sections_of
    from factorgraph_loc.sensors.tables import tables_of_sensor

    tables = [
        {"name": table.name, "columns": [_column(column) for column in table.columns]}
        for table in tables_of_sensor(sensor)
    ]
    return {**_summary(sensor), "tables": tables, "settings": sections_of(sensor)}


def _column(column: Column) -> dict[str, Any]:
    return {
        "name": column.name,
        "kind": column.kind,
        "unit": column.unit,
        "low": column.low if column.units else None,
        "high": column.high if column.units else None,
        "may_lack": column.may_lack,
        "meaning": column.doc,
    }


def _print_sensor(sensor: SensorType) -> None:
    from factorgraph_loc.sensors.registry import sections_of
    from factorgraph_loc.sensors.tables import tables_of_sensor

    found = _summary(sensor)
    show.fields(
        {"sensor": sensor.name, "what it is": found["about"], "--sensors": ", ".join(found["channels"])}
        | ({"rig": _sections(sensor)} if sensor.settings else {})
    )
    for table in tables_of_sensor(sensor):
        show.line()
        show.line(f"table {table.name}")
        rows = [(column.name, column.values, column.doc) for column in table.columns]
        show.table(("column", "values", "what it is"), rows, wrapped=("values", "what it is"))
    for section, settings in sections_of(sensor).items():
        show.line()
        show.line(f"[{section}] of a rig")
        _print_settings(settings)


def _sections(sensor: SensorType) -> str:
    return ", ".join(f"[{section}]" for section in sensor.settings)


def _print_settings(settings: Sequence[Setting], word: str = "setting") -> None:
    from factorgraph_loc.files.settings import default_text, values_text

    if settings:
        rows = [(s.key, default_text(s), values_text(s), s.meaning) for s in settings]
        show.table((word, "default", "values", "what it is"), rows, wrapped=("values", "what it is"))
    else:
        show.line(f"no {word}s")


def _estimates(found: Description) -> str:
    return ", ".join(name for name, there in (("causal", found.causal), ("smoothed", found.smoothed)) if there)
