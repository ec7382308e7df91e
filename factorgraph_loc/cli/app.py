"""The Typer application. Commands only parse and print; numerical libraries are imported inside the commands."""

import sys
import traceback
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from factorgraph_loc.cli import (
    experimenting,
    inspecting,
    learning,
    lookups,
    rigs,
    running,
    scoring,
    show,
    viewing,
)
from factorgraph_loc.cli.stopping import OutputError, end, standard_streams, unwrapped
from factorgraph_loc.errors import FglocError, message_of
from factorgraph_loc.files.bounded import limit_memory
from factorgraph_loc.text import MESSAGE, plain
from factorgraph_loc.threads import use_one_thread
from factorgraph_loc.version import __version__

DEBUG = "--debug"
_UsageError: Any = typer.BadParameter.__mro__[1]  # the class UsageError of click, or of the copy of click inside Typer
UNFORESEEN = 70  # exit code of an internal error: EX_SOFTWARE of sysexits.h


class Commands(TyperGroup):
    """The group of all commands. It prints an error of a command as one line on stderr and sets the exit code."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Move ``--debug`` to the start of the arguments, so that users may write it anywhere on the command line."""
        if DEBUG in args:
            args = [DEBUG, *(arg for arg in args if arg != DEBUG)]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            with unwrapped():
                return super().invoke(ctx)
        except (FglocError, OSError, UnicodeEncodeError) as error:
            if ctx.params.get("debug") or getattr(error, "encoding", "") == "utf-8":
                raise
            show.note(f"error: {message_of(error)}")
            raise typer.Exit(getattr(error, "exit_code", FglocError.exit_code)) from error
        except _UsageError as error:
            error.message = plain(error.message, MESSAGE)
            raise
        except KeyboardInterrupt as stop:
            raise typer.Exit(end(stop)) from stop


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 success; 1 a run failed (other runs are reported); 2 invalid input, or a file or standard output "
    "cannot be written; 70 internal error; 129 hung up; 130 interrupted; 143 terminated; 141 the reader of the output "
    "closed the pipe.",
)
app.command()(inspecting.datasets)
app.command()(lookups.estimators)
app.command()(lookups.sensors)
app.command()(lookups.readers)
app.command()(lookups.presets)
app.command()(lookups.policies)
app.command()(inspecting.info)
app.command()(inspecting.convert)
app.command()(inspecting.manifest)
app.command()(running.run)
app.command()(running.compare)
app.command()(scoring.score)
app.command()(viewing.view)
app.command()(viewing.export)
app.command()(learning.calibrate)
app.command("map")(learning.map_)
app.command()(inspecting.simulate)
app.command()(experimenting.active)
app.add_typer(rigs.app, name="rigs")
app.add_typer(experimenting.app, name="experiment")
app.add_typer(scoring.features, name="features")


def _print_version(wanted: bool) -> None:
    if wanted:
        show.line(f"fgloc {__version__}")
        raise typer.Exit


@app.callback()
def fgloc(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[
        bool, typer.Option(DEBUG, help="Show the traceback of an error. May be given anywhere on the line.")
    ] = False,
) -> None:
    """Localize robots from logs: inspect a log, run estimators on it, compare them."""


def run() -> None:
    """Run the command with the arguments of this process, then exit."""
    use_one_thread()
    limit_memory()
    try:
        with unwrapped(), standard_streams():
            app()
    except OutputError as error:  # raised also while --help or --version are printed
        show.note(f"error: {error}")
        sys.exit(error.exit_code)
    except Exception as error:
        for line in traceback.format_exc().splitlines():
            show.note(line)
        sys.exit(error.exit_code if isinstance(error, FglocError) else UNFORESEEN)
