"""The commands ``fgloc estimators``, ``sensors``, ``readers``, ``presets`` and ``policies``, which list what a user can choose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json
from factorgraph_loc.plugins import PRESETS

if TYPE_CHECKING:
    from factorgraph_loc.api.lookups import NamedSettings, SensorDescription
    from factorgraph_loc.files.settings import Setting
    from factorgraph_loc.fusion.registry import Description


def _name(what: str, complete: completion.Completion) -> Any:
    return typer.Argument(metavar="NAME", help=f"Print the {what} of the entry NAME.", autocompletion=complete)


def estimators(name: Annotated[str | None, _name("settings", completion.estimator)] = None, json: Json = False) -> None:
    """List the estimators, or the settings of the estimator NAME.

    Example: fgloc estimators smoother
    """
    from factorgraph_loc.api.lookups import known_estimators
    from factorgraph_loc.fusion.registry import describe

    if name is None:
        known = known_estimators()
        rows = [(e.name, _estimates(e), e.about, ", ".join(e.sensors)) for e in known]
        _print_list(json, known, ("name", "estimates", "what it is", "sensors"), rows, ("what it is", "sensors"))
        return
    chosen = describe(name)
    about = {"estimator": name, "what it is": chosen.about, "estimates": _estimates(chosen)}
    first = chosen.settings[0].key if chosen.settings else ""
    hint = f"to change one: fgloc run LOG -e {name} --set {name}.{first}=VALUE"
    _print_one(json, chosen, about | {"sensors": ", ".join(chosen.sensors)}, hint)


def readers(name: Annotated[str | None, _name("options", completion.reader)] = None, json: Json = False) -> None:
    """List the readers of logs, or the options of the reader NAME.

    Example: fgloc readers mapped
    """
    from factorgraph_loc.api.lookups import describe_reader, known_readers

    if name is None:
        known = known_readers()
        _print_list(json, known, ("name", "format"), [(r.name, r.about) for r in known], ("format",))
        return
    chosen = describe_reader(name)
    hint = "options are in [options] of a manifest, or --reader-option KEY=VALUE"
    _print_one(json, chosen, {"reader": name, "format": chosen.about}, hint, "option")


def sensors(
    name: Annotated[str | None, _name("tables and settings", completion.sensor)] = None, json: Json = False
) -> None:
    """List the sensors, or the tables and rig settings of the sensor NAME.

    Example: fgloc sensors rfid
    """
    from factorgraph_loc.api.lookups import describe_sensor, known_sensors

    if name is None:
        known = known_sensors()
        rows = [(s.name, s.about, ", ".join(s.channels), _sections(s)) for s in known]
        header = ("name", "what it is", "--sensors", "rig")
        _print_list(json, known, header, rows, ("what it is", "--sensors"))
    elif json:
        show.document(describe_sensor(name))
    else:
        _print_sensor(describe_sensor(name))


def presets(name: Annotated[str | None, _name("settings", completion.preset)] = None, json: Json = False) -> None:
    """List the presets of simulated logs, or the settings of the preset NAME.

    Example: fgloc presets office
    """
    from factorgraph_loc.api.lookups import describe_preset

    if name is None:
        known = [{"name": name, "about": about} for name, about in PRESETS.items()]
        _print_list(json, known, ("name", "world"), [*PRESETS.items()], ("world",))
        return
    chosen = describe_preset(name)
    about = {"preset": name, "world": chosen.about, "rig": f"fgloc rigs show {name}; --set rig.KEY=VALUE"}
    _print_one(
        json, chosen, about, f"to change one: fgloc simulate {name} --set drive.duration=VALUE, or a file of settings"
    )


def policies(json: Json = False) -> None:
    """List the policies and the settings of `fgloc active`. A policy chooses the paths of the robot.

    Example: fgloc policies
    """
    from factorgraph_loc.api.lookups import known_policies

    known = known_policies()
    _print_list(json, known, ("policy", "next path"), [(policy.name, policy.about) for policy in known], ("next path",))
    if not json:
        show.line()
        hint = "to change one: fgloc active WORLD --set policy.horizon=VALUE; settings of the world as in fgloc presets WORLD"
        _print_settings(known[0].settings, hint)


def _print_list(
    json: bool, document: Any, header: Sequence[str], rows: Sequence[Sequence[str]], wrapped: Sequence[str]
) -> None:
    if json:
        show.document(document)
    else:
        show.table(header, rows, wrapped)


def _print_one(
    json: bool, choice: NamedSettings | Description, about: Mapping[str, str], hint: str, word: str = "setting"
) -> None:
    if json:
        show.document(choice)
        return
    show.fields(about)
    show.line()
    _print_settings(choice.settings, hint, word)


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


def _print_settings(settings: Sequence[Setting], hint: str = "", word: str = "setting") -> None:
    from factorgraph_loc.files.settings import default_text, values_text

    if not settings:
        show.line(f"no {word}s")
        return
    rows = [(s.key, default_text(s), values_text(s), s.meaning) for s in settings]
    show.table((word, "default", "values", "what it is"), rows, wrapped=("values", "what it is"))
    if hint:
        show.line()
        show.line(hint)


def _estimates(estimator: Description) -> str:
    return ", ".join(kind for kind in ("causal", "smoothed") if getattr(estimator, kind))
