"""``fgloc estimators``: what there is to choose from, and its settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json
from factorgraph_loc.plugins import ESTIMATORS

if TYPE_CHECKING:
    from factorgraph_loc.files.settings import Setting
    from factorgraph_loc.fusion.registry import Description


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
            show.document({**asdict(found), "settings": [document(setting) for setting in settings]})
            return
        about = {"estimator": name, "what it is": found.about, "estimates": _estimates(found)}
        show.fields(about | {"sensors": ", ".join(found.sensors)})
        show.line()
        print_settings(settings)
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


def document(setting: Setting) -> dict[str, Any]:
    """A setting in JSON; bounds that there are not are null."""
    return asdict(setting)


def print_settings(settings: Sequence[Setting]) -> None:
    """Print a table of settings."""
    from factorgraph_loc.files.settings import default_text, values_text

    if settings:
        rows = [(s.key, default_text(s), values_text(s), s.meaning) for s in settings]
        show.table(("setting", "default", "values", "what it is"), rows, wrapped=("values", "what it is"))
    else:
        show.line("no settings")


def _estimates(found: Description) -> str:
    return ", ".join(name for name, there in (("causal", found.causal), ("smoothed", found.smoothed)) if there)
