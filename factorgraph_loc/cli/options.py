"""Options shared by several commands, and the parsing of their values."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from factorgraph_loc.cli import completion
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Alignment
from factorgraph_loc.text import listed, quoted, well_formed

if TYPE_CHECKING:
    from factorgraph_loc.model.log import Log

LogName = Annotated[
    str,
    typer.Argument(
        metavar="LOG",
        help="A name that `fgloc datasets` lists, a manifest, a folder in the native format, a file of poses, or any path with "
        "--reader.",
        autocompletion=completion.logs,
    ),
]
LogNames = Annotated[
    list[str],
    typer.Argument(
        metavar="LOG...",
        help="Names that `fgloc datasets` lists, manifests, folders.",
        autocompletion=completion.logs,
    ),
]
DataRoot = Annotated[
    Path | None,
    typer.Option(
        help="Data folder. Paths in manifests and experiments may lead into it. Default: the variable FGLOC_DATA."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]
Out = Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.")]
Estimator = Annotated[
    str,
    typer.Option("--estimator", "-e", metavar="NAME", help="The estimator.", autocompletion=completion.estimator),
]
Estimators = Annotated[
    str,
    typer.Option("--estimators", "-e", metavar="A,B", help="The estimators.", autocompletion=completion.estimators),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing results.")]
Prior = Annotated[
    str | None,
    typer.Option(
        metavar="PRIOR",
        help="Start pose: reference, log, unknown, X,Y [m] or X,Y,HEADING [rad]. Default: the log's start, else the reference.",
        autocompletion=completion.prior,
    ),
]
Seeds = Annotated[str, typer.Option(metavar="FIRST:END", help="Seeds, END not included; or one number.")]
Jobs = Annotated[int | None, typer.Option(help="Number of processes; by default one per core.", min=1)]
MaxGap = Annotated[
    float,
    typer.Option(metavar="SECONDS", help="Longest time between estimates across which scoring interpolates."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME.KEY=VALUE",
        help="Setting of an estimator, such as smoother.lag=10; `fgloc estimators NAME` lists them. May be repeated.",
        autocompletion=completion.setting,
    ),
]


@dataclass(frozen=True)
class LogOptions:
    """The options that select and configure the reader of a log, and replace its rig or map."""

    reader: Annotated[
        str | None,
        typer.Option(
            help="Reader of LOG, if LOG is neither a manifest nor a native folder.", autocompletion=completion.reader
        ),
    ] = None
    reader_option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Option of the reader; may be repeated.")
    ] = None
    data_root: DataRoot = None
    rig: Annotated[Path | None, typer.Option(metavar="FILE", help="A .rig.toml to use instead of the log's rig.")] = (
        None
    )
    world: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A .world.toml to use instead of the log's map.")
    ] = None

    def load(self, names: Sequence[str]) -> list[Log]:
        """Read the logs with the given names and return them. One name may refer to several logs."""
        from factorgraph_loc.io.readers import load

        return [log for name in names for log in load(name, **self._given())]

    def load_one(self, name: str) -> Log:
        """Read the log with a given name and return it. Raises InputError if the name refers to several logs."""
        from factorgraph_loc.io.readers import read_log

        return read_log(name, **self._given())

    def _given(self) -> dict[str, Any]:
        options = dict(key_and_value(text, "--reader-option") for text in self.reader_option or ())
        given = vars(self) | {"options": options}
        del given["reader_option"]
        return given


@dataclass(frozen=True)
class RunOptions:
    """The options that ``fgloc run`` and ``fgloc compare`` share."""

    sensors: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="Sensors that the estimators may use; by default those of the rig.",
            autocompletion=completion.sensors,
        ),
    ] = None
    prior: Prior = None
    set_: Settings = None
    max_gap: MaxGap = MAX_GAP
    tick_gap: Annotated[
        float,
        typer.Option(metavar="SECONDS", help="Gaps between measurements longer than this contain no estimates."),
    ] = TICK_GAP
    align: Annotated[
        Alignment,
        typer.Option(
            help="Also show the errors after an alignment with the reference: first pose onto first pose, or by least "
            "squares in the plane, in space, or in space with a scale."
        ),
    ] = "none"
    rpe: Annotated[
        bool, typer.Option("--rpe", help="Also show relative errors over a metre of path and over a second.")
    ] = False
    overwrite: Overwrite = False

    def given(self) -> dict[str, Any]:
        """Return all options except ``--set`` as keyword arguments for the functions ``run`` and ``compare``."""
        given = {key: value for key, value in vars(self).items() if key not in ("set_", "rpe")}
        return given | {"sensors": parse_list(self.sensors) if self.sensors else None}


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command that has dataclasses as arguments, such as :class:`LogOptions`. Return the decorated command.

    On the command line, each field of such a dataclass is an option of its own. The command is called with instances of
    the dataclasses, which contain the values of the options.
    """
    given = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {p.name: p.annotation for p in given.parameters.values() if is_dataclass(p.annotation)}
    parameters: list[inspect.Parameter] = []
    for parameter in given.parameters.values():
        if kind := groups.get(parameter.name):
            hints = get_type_hints(kind, include_extras=True)
            parameters += [
                parameter.replace(name=f.name, default=f.default, annotation=hints[f.name]) for f in fields(kind)
            ]
        else:
            parameters.append(parameter)

    @wraps(command)
    def expanded(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        command(**values)

    expanded.__signature__ = given.replace(parameters=parameters)  # type: ignore[attr-defined] # Typer reads it
    expanded.__annotations__ = {p.name: p.annotation for p in parameters}
    return expanded


def parse_list(text: str) -> tuple[str, ...]:
    """Return the parts of a comma-separated list: ``a, b`` becomes ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def parse_settings(
    texts: Sequence[str], estimators: Sequence[str], sections: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """Return the values of ``--set`` by estimator and key: ``smoother.lag=10`` becomes {"smoother": {"lag": 10}}.

    ``estimators``: names of the estimators that are run. ``sections``: other names that a setting may start with.
    Raises InputError if a setting starts with another name.
    """
    from factorgraph_loc.files.models import set_key
    from factorgraph_loc.fusion.registry import check_names

    settings: dict[str, Any] = {name: {} for name in (*estimators, *sections)}
    for text in texts:
        key, value = key_and_value(text, "--set")
        estimator, dot, _ = key.partition(".")
        if not dot or not all(key.split(".")):
            raise InputError(f"--set is {quoted(text)}, expected NAME.key=value, such as smoother.lag=10")
        if estimator not in sections:
            check_names([estimator])
        if estimator not in settings:
            raise InputError(f"--set is {quoted(text)}, but {estimator} is not run here, expected {listed(estimators)}")
        set_key(settings, key, value, "--set")
    return settings


def nested_changes(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of ``--set`` as nested dictionaries: ``a.b=3`` becomes {"a": {"b": 3}}."""
    from factorgraph_loc.files.models import set_key

    changes: dict[str, Any] = {}
    for key, value in (key_and_value(text, "--set") for text in texts):
        set_key(changes, key, value, "--set")
    return changes


def key_and_value(text: str, option: str) -> tuple[str, Any]:
    """Return the key and the value in ``text``: ``a.b=3`` becomes ("a.b", 3). ``option``: named in errors."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip() or not value.strip() or text != well_formed(text):
        raise InputError(f"{option} is {quoted(text)}, expected KEY=VALUE")
    return key.strip(), _scalar(value.strip())


def _scalar(text: str) -> Any:
    """Return the value of a TOML text, such as 3 for "3". Return a date, and a text that is not TOML, unchanged."""
    from factorgraph_loc.files.models import parse_toml

    try:
        table = parse_toml(f"value = {text}", "a value")
    except InputError:
        return text
    return table["value"] if len(table) == 1 else text
