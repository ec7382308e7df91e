"""Output of the commands: lines, tables and JSON on stdout, and messages on stderr. Nothing is truncated, also in a pipe."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

from factorgraph_loc.text import MESSAGE, one_line, plain, plain_values

WARNINGS = 20  # number of warnings printed
FORECAST_AFTER, LONG = 3.0, 20.0  # s: time before a duration is predicted; smaller durations are not printed
MINUTE = 60.0  # s
NARROW, PADDING = 18, 2  # characters: minimum width of a wrapped column, padding of each column


def line(text: str = "") -> None:
    """Print the line ``text`` on stdout, with non-printable characters escaped."""
    print(plain(text, None), flush=True)


def lines(text: str) -> None:
    """Print text of several lines on stdout, such as the content of a file. Non-printable characters are escaped."""
    for row in text.split("\n"):
        line(row)


def note(text: str) -> None:
    """Print a message, such as a warning, as a line on stderr."""
    print(plain(text, None), file=sys.stderr, flush=True)


def warnings(doubts: Sequence[object]) -> None:
    """Print the first :data:`WARNINGS` of the warnings ``doubts`` on stderr, one per line, and how many are not printed."""
    for doubt in doubts[:WARNINGS]:
        note(f"warning: {one_line(str(doubt))}")
    if len(doubts) > WARNINGS:
        note(f"warning: {len(doubts) - WARNINGS} more warnings are listed with the results")


def outcome(doubts: Sequence[str], failures: Sequence[str], most: int | None = None, more: str = "") -> None:
    """Print the warnings ``doubts`` and the texts ``failures`` of several runs on stderr, one per line.

    ``most``: maximum number of failures to print, None for all. ``more``: end of the line "failed: N more", which is
    printed if there are further failures.
    """
    warnings(doubts)
    for failure in failures[:most]:
        note(f"failed: {failure}")
    if most is not None and len(failures) > most:
        note(f"failed: {len(failures) - most} more{more}")


def document(content: Any) -> None:
    """Print ``content`` as JSON on stdout. NaN and infinity become null, non-printable characters are escaped."""
    unicode = sys.stdout.encoding.lower().startswith("utf")
    text = json.dumps(plain_values(content), indent=2, ensure_ascii=not unicode)
    print("".join(c if c == "\n" or c.isprintable() else json.dumps(c)[1:-1] for c in text), flush=True)


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], wrapped: Sequence[str] = (), *, grouped: bool = False
) -> None:
    """Print a table on stdout. The first column is left-aligned, and columns of numbers are right-aligned.

    ``wrapped``: names of the columns whose text is wrapped in a narrow terminal; no text is truncated. ``grouped``: the first two
    columns are labels. A line separates rows with different first labels, and each word of the header is on its own line.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    out = Table(box=box.SIMPLE_HEAD if grouped else None, pad_edge=grouped, header_style="bold")
    least: list[int] = []
    for i, name in enumerate(header):
        numeric = i > 1 if grouped else i > 0 and all(_is_number(row[i]) for row in rows)
        title = plain(name).replace(" ", "\n" if grouped else " ")
        longest = max(map(len, (*title.split("\n"), *(row[i] for row in rows))))
        least.append(min(longest, NARROW) if name in wrapped else longest)
        justify: Literal["left", "right"] = "right" if numeric else "left"
        out.add_column(title, justify=justify, no_wrap=name not in wrapped, overflow="fold", min_width=least[-1])
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        ends = grouped and (following is None or following[0] != row[0])
        out.add_row(*(plain(cell, MESSAGE) for cell in row), end_section=ends)
    # without a height, rich would assume 80 columns in a dumb terminal
    console = Console(markup=False, emoji=False, highlight=False, width=1000, height=1000)
    if sys.stdout.isatty():
        whole = console.measure(out).maximum
        console.width = max(_terminal_width(), sum(least) + PADDING * len(least) if wrapped else whole)
    console.print(out)


def _terminal_width() -> int:
    """Return the width of the terminal of stdout, in characters. ``sys.stdout`` may have been replaced."""
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns
    except OSError:
        return shutil.get_terminal_size().columns


def first_use() -> None:
    """Announce that numba will compile functions, if the cache has no compiled function yet. Call this before a run."""
    from factors.odometry.kernels import relative  # a compiled function that every run calls

    function: Any = relative  # numba replaces it by an object with statistics
    cache = function.stats.cache_path
    if cache is None or not any(Path(cache).glob("*.relative-*.nbi")):
        note("the first use of fgloc compiles functions, for up to a minute")


@contextmanager
def progress(what: str, *, counted: bool) -> Iterator[Callable[..., None]]:
    """Show a progress bar on stderr in this block. If stderr is no terminal, the expected duration of a long block is printed.

    Yields a function ``update(done, total, remark="")`` that moves the bar. ``what``: title of the bar. ``counted``: if
    set, the bar shows ``done`` and ``total`` as counts, otherwise a percentage.
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
    if not console.is_terminal:
        yield _Forecast(plain(what)).update
        return
    amount = MofNCompleteColumn() if counted else TaskProgressColumn()
    title, remarks = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[remark]}", markup=False)
    columns = (title, BarColumn(), amount, TimeRemainingColumn(), remarks)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(plain(what), total=None, remark="")
        yield lambda done, total, remark="": bar.update(task, completed=done, total=total, remark=plain(remark))


class _Forecast:
    """Prints the expected duration of a block once, if it is at least :data:`LONG`. ``what``: the name of the block."""

    def __init__(self, what: str) -> None:
        self._what, self._started, self._is_printed = what, perf_counter(), False

    def update(self, done: float, total: float, _: str = "") -> None:
        """Report that the fraction ``done`` / ``total`` of the block is finished."""
        elapsed = perf_counter() - self._started
        if self._is_printed or elapsed < FORECAST_AFTER or not 0.0 < done < total:
            return
        expected = elapsed * total / done
        if expected >= LONG:
            self._is_printed = True
            duration = f"{expected:.0f} s" if expected < 2.0 * MINUTE else f"{expected / MINUTE:.0f} min"
            note(f"{self._what}: takes about {duration}")


def fields(content: Mapping[str, str]) -> None:
    """Print each name of ``content`` and its value on a line."""
    width = max(map(len, content))
    for name, value in content.items():
        line(f"{name:<{width}}  {value}")


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(".", "", 1).lstrip("-").isdigit()
