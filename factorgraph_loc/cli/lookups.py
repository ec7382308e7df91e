"""``fgloc estimators``, ``sensors``, ``readers``, ``presets`` and ``policies``: what there is to choose from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json

if TYPE_CHECKING:
    from factorgraph_loc.api.lookups import SensorDescription
    from factorgraph_loc.files.columns import Column
    from factorgraph_loc.files.settings import Setting
    from factorgraph_loc.fusion.registry import Description

DURATION = "drive.duration"


def estimators(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Print the settings of this one.", autocompletion=completion.estimator),
    ] = None,
    json: Json = False,
) -> None:
    """List the estimators, or the settings of one."""
    from factorgraph_loc.api.lookups import known_estimators
    from factorgraph_loc.fusion.registry import describe

    if name is not None:
        found = describe(name)
        settings = found.settings
        if json:
            show.document(found)
            return
        about = {"estimator": name, "what it is": found.about, "estimates": _estimates(found)}
        show.fields(about | {"sensors": ", ".join(found.sensors)})
        show.line()
        _print_settings(settings)
        if settings:
            show.line()
            show.line(f"to change one: fgloc run LOG -e {name} --set {name}.{settings[0].key}=VALUE")
        return
    known = known_estimators()
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
    from factorgraph_loc.api.lookups import describe_reader, known_readers

    if name is not None:
        found = describe_reader(name)
        if json:
            show.document(found)
            return
        show.fields({"reader": name, "format": found.about})
        show.line()
        _print_settings(found.options, "option")
        if found.options:
            show.line()
            show.line("options are in [options] of a manifest, or --reader-option KEY=VALUE")
        return
    known = known_readers()
    if json:
        show.document(known)
    else:
        show.table(("name", "format"), [(one.name, one.about) for one in known], wrapped=("format",))


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
    from factorgraph_loc.api.lookups import describe_sensor, known_sensors

    if name is not None:
        sensor = describe_sensor(name)
        if json:
            show.document(_document(sensor))
        else:
            _print_sensor(sensor)
        return
    known = known_sensors()
    if json:
        show.document([_summary(sensor) for sensor in known])
        return
    rows = [(s.name, s.about, ", ".join(s.channels), _sections(s)) for s in known]
    show.table(("name", "what it is", "--sensors", "rig"), rows, wrapped=("what it is", "--sensors"))


def presets(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Print the settings of this one.", autocompletion=completion.preset),
    ] = None,
    json: Json = False,
) -> None:
    """List the presets of simulated logs, or the settings of one."""
    from factorgraph_loc.api.lookups import describe_preset, known_presets

    if name is not None:
        found = describe_preset(name)
        if json:
            show.document(found)
            return
        show.fields({"preset": name, "world": found.about, "rig": f"fgloc rigs show {name}; --set rig.KEY=VALUE"})
        show.line()
        _print_settings(found.settings)
        show.line()
        show.line(f"to change one: fgloc simulate {name} --set {DURATION}=VALUE, or a file of settings")
        return
    known = known_presets()
    if json:
        show.document([{"name": one.name, "about": one.about} for one in known])
    else:
        show.table(("name", "world"), [(one.name, one.about) for one in known], wrapped=("world",))


def policies(json: Json = False) -> None:
    """List the policies of active robots, and the settings of `fgloc active`."""
    from factorgraph_loc.api.lookups import known_policies

    known = known_policies()
    if json:
        show.document(known)
        return
    show.table(("policy", "next path"), [*known.policies.items()], wrapped=("next path",))
    show.line()
    _print_settings(known.settings)
    show.line()
    show.line(
        "to change one: fgloc active WORLD --set policy.horizon=VALUE; settings of the world as in fgloc presets WORLD"
    )


def _summary(sensor: SensorDescription) -> dict[str, Any]:
    return {"name": sensor.name, "about": sensor.about, "channels": sensor.channels, "rig": list(sensor.rig)}


def _document(sensor: SensorDescription) -> dict[str, Any]:
    tables = [
        {"name": name, "columns": [_column(column) for column in columns]} for name, columns in sensor.tables.items()
    ]
    return {**_summary(sensor), "tables": tables, "settings": sensor.rig}


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


def _print_sensor(sensor: SensorDescription) -> None:
    show.fields(
        {"sensor": sensor.name, "what it is": sensor.about, "--sensors": ", ".join(sensor.channels)}
        | ({"rig": _sections(sensor)} if sensor.rig else {})
    )
    for name, columns in sensor.tables.items():
        show.line()
        show.line(f"table {name}")
        rows = [(column.name, column.values, column.doc) for column in columns]
        show.table(("column", "values", "what it is"), rows, wrapped=("values", "what it is"))
    for section, settings in sensor.rig.items():
        show.line()
        show.line(f"[{section}] of a rig")
        _print_settings(settings)


def _sections(sensor: SensorDescription) -> str:
    return ", ".join(f"[{section}]" for section in sensor.rig)


def _print_settings(settings: Sequence[Setting], word: str = "setting") -> None:
    from factorgraph_loc.files.settings import default_text, values_text

    if settings:
        rows = [(s.key, default_text(s), values_text(s), s.meaning) for s in settings]
        show.table((word, "default", "values", "what it is"), rows, wrapped=("values", "what it is"))
    else:
        show.line(f"no {word}s")


def _estimates(found: Description) -> str:
    return ", ".join(name for name, there in (("causal", found.causal), ("smoothed", found.smoothed)) if there)
