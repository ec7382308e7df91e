"""Insertion of tables into pages of the docs, and the command line of the scripts that print or insert tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

MARK = "<!-- tables -->\n"


def with_tables(page: str, lines: Iterable[str], section: str = "") -> str:
    """Return the text ``page`` with ``lines`` below the mark :data:`MARK`. They replace the text up to the end of the section.

    ``section``: the heading of the section with the mark; empty for the whole page. Exits if there is no mark.
    """
    before, heading, rest = page.partition(f"## {section}\n") if section else ("", "", page)
    inside, following, after = rest.partition("\n## ") if section else (rest, "", "")
    prose, mark, _ = inside.partition(MARK)
    if not mark:
        sys.exit(f"the page has no line {MARK.strip()}" + (f" in the section {section}" if section else ""))
    return "".join((before, heading, prose, mark, "\n", "\n".join(lines).rstrip("\n"), "\n", following, after))


def main(about: str, sections: Mapping[str, Callable[[], Iterable[str]]]) -> None:
    """Print the tables of a script, or insert them into the page of the option --docs.

    ``about``: the description for --help. ``sections``: by heading of a section, a function that returns the lines of its tables.
    The heading "" means the whole page.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument(
        "--docs", type=Path, metavar="PAGE", help=f"page to insert the tables into, below {MARK.strip()}"
    )
    page = parser.parse_args().docs
    for section, lines in sections.items():
        if page is None:
            print("\n".join(lines()))
        else:
            page.write_text(with_tables(page.read_text(), lines(), section))
