"""How results look on the terminal: plain tables that nothing cuts off, also in a pipe."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from typing import TYPE_CHECKING, Any

from factorgraph_loc.text import MESSAGE, one_line, plain

if TYPE_CHECKING:
    from rich.table import Table

WARNINGS = 20  # that are printed


def line(text: str = "") -> None:
    """A line on stdout, the only way there but for tables and documents. What no terminal shows as a character is escaped."""
    print(plain(text, None), flush=True)


def lines(text: str) -> None:
    """Text of several lines on stdout, such as a file."""
    for one in text.split("\n"):
        line(one)


def note(text: str) -> None:
    """A line for people, on stderr: where results are, what is doubtful."""
    print(plain(text, None), file=sys.stderr, flush=True)


def warnings(texts: Sequence[str]) -> None:
    """What is doubtful, a line each on stderr; of very many the first, for all stand with the results."""
    for one in texts[:WARNINGS]:
        note(f"warning: {one_line(one)}")
    if len(texts) > WARNINGS:
        note(f"warning: {len(texts) - WARNINGS} more stand with the results")


def document(content: Any) -> None:
    """One JSON document on stdout; what JSON cannot say (NaN, infinity) is null, what a terminal does not show is escaped."""
    unicode = sys.stdout.encoding.lower().startswith("utf")
    text = json.dumps(_plain(content), indent=2, ensure_ascii=not unicode)
    print("".join(c if c == "\n" or c.isprintable() else json.dumps(c)[1:-1] for c in text), flush=True)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on stdout: the first column to the left, numbers to the right."""
    from rich.table import Table

    out = Table(box=None, pad_edge=False, header_style="bold")
    for i, name in enumerate(header):
        numeric = i > 0 and all(_is_number(row[i]) for row in rows)
        out.add_column(plain(name), justify="right" if numeric else "left", no_wrap=True)
    for row in rows:
        out.add_row(*(plain(cell, MESSAGE) for cell in row))
    rich_table(out)


def rich_table(content: Table) -> None:
    """A table of rich's on stdout. In a narrow terminal its lines are broken, but nothing is cut off."""
    from rich.console import Console

    console = Console(markup=False, emoji=False, highlight=False, width=1000)
    if sys.stdout.isatty():
        console.width = max(shutil.get_terminal_size().columns, console.measure(content).maximum)
    console.print(content)


@contextmanager
def progress(what: str, *, counted: bool) -> Iterator[Callable[..., None]]:
    """A bar on stderr while the block lasts, to be told how much is done of how much, and a remark if there is one; silent where
    stderr is no terminal.

    ``counted``: these are numbers of things, shown as such; else a percentage is shown.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    amount = MofNCompleteColumn() if counted else TaskProgressColumn()
    title, remarks = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[remark]}", markup=False)
    columns = (title, BarColumn(), amount, TimeRemainingColumn(), remarks)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(plain(what), total=None, remark="")
        yield lambda done, total, remark="": bar.update(task, completed=done, total=total, remark=plain(remark))


def fields(content: Mapping[str, str]) -> None:
    """Names and values, one pair a line."""
    width = max(map(len, content))
    for name, value in content.items():
        line(f"{name:<{width}}  {value}")


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(".", "", 1).lstrip("-").isdigit()


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if hasattr(value, "tolist"):  # an array
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
