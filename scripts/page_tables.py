"""Tables in pages of the docs, and the command line of scripts that print or insert them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

MARK = "<!-- tables -->\n"


def with_tables(page: str, lines: Iterable[str], section: str = "") -> str:
    """The page with ``lines`` below :data:`MARK`, to the end of a section or of the page. Exits if there is no mark."""
    before, heading, rest = page.partition(f"## {section}\n") if section else ("", "", page)
    inside, following, after = rest.partition("\n## ") if section else (rest, "", "")
    prose, mark, _ = inside.partition(MARK)
    if not mark:
        sys.exit(f"the page has no line {MARK.strip()}" + (f" in a section {section}" if section else ""))
    return "".join((before, heading, prose, mark, "\n", "\n".join(lines).rstrip("\n"), "\n", following, after))


def main(about: str, sections: Mapping[str, Callable[[], Iterable[str]]]) -> None:
    """Print the lines of all sections, or insert them into a page; ``""`` is the whole page."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--docs", type=Path, metavar="PAGE", help=f"the page to put them into, below {MARK.strip()}")
    page = parser.parse_args().docs
    for section, lines in sections.items():
        if page is None:
            print("\n".join(lines()))
        else:
            page.write_text(with_tables(page.read_text(), lines(), section))
