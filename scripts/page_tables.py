"""The command line of scripts that print tables, or insert them into a page of the docs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

MARK = "<!-- tables -->"


def main(about: str, tables: Callable[[], Iterable[str]]) -> None:
    """Print the lines of ``tables``, or insert them into a page below :data:`MARK`."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--docs", type=Path, metavar="PAGE", help=f"the page to put them into, below {MARK}")
    page = parser.parse_args().docs
    text = "\n".join(tables())
    if page is None:
        print(text)
        return
    before, mark, _ = page.read_text().partition(MARK)
    if not mark:
        parser.error(f"{page} has no line {MARK}")
    page.write_text(f"{before}{MARK}\n\n{text}\n")
