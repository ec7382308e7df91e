"""The command line of a benchmark: sections, each a module with ``section(options)``, and a page for their tables."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarking.report import Options
from factorgraph_loc.files.models import read_text, write_text

TABLES = "<!-- tables -->\n"


def parser(description: str, sections: Sequence[str], out: str) -> argparse.ArgumentParser:
    """The common options; results go to ``out`` by default."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument(
        "sections", nargs="*", choices=[*sections, []], default=[], metavar="SECTION", help="by default all"
    )
    made.add_argument(
        "--seeds", type=_at_least_one, help="simulated logs of each kind; by default as many as the docs say"
    )
    made.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at a time (%(default)s)")
    made.add_argument("--data-root", type=Path, help="folder of recorded data; by default FGLOC_DATA")
    made.add_argument("--docs", type=Path, metavar="PAGE", help="put the tables into this page, below <!-- tables -->")
    made.add_argument("-o", "--out", type=Path, default=Path(out), help="(%(default)s)")
    return made


def _at_least_one(text: str) -> int:
    if int(text) < 1:
        raise argparse.ArgumentTypeError("expected 1 or more")
    return int(text)


def run_benchmark(description: str, sections: Sequence[str], name: str) -> None:
    """The command of a benchmark with the common options alone; its package and the folder of its results have its ``name``."""
    arguments = parser(description, sections, f"out/bench-{name}").parse_args()
    options = Options(arguments.seeds, arguments.jobs, arguments.data_root, arguments.out)
    run_sections(f"{name}_benchmark", arguments.sections or sections, options, arguments.docs)


def run_sections(package: str, sections: Sequence[str], options: Options, page: Path | None) -> None:
    """Run sections of a package, print their tables, write them to ``options.out`` and a page; exit with 1 if one failed."""
    options.out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in sections:
        started = time.perf_counter()
        report = importlib.import_module(f"{package}.{name}").section(options)
        text = "\n".join([f"## {name}", "", *report.lines])
        print(text, flush=True)
        print(f"{name}: {time.perf_counter() - started:.0f} s", file=sys.stderr)
        write_text(options.out / f"{name}.md", text)
        if page is not None:
            write_text(page, with_tables(read_text(page), name, report.lines))
        failed += [f"{name}, {line}" for line in report.failed]
    if failed:
        sys.exit("failed: " + "; ".join(failed))


def with_tables(page: str, name: str, lines: Sequence[str]) -> str:
    """The page with the tables of this section replaced by ``lines``."""
    before, heading, rest = page.partition(f"## {name}\n")
    section, following, after = rest.partition("\n## ")
    prose, mark, _ = section.partition(TABLES)
    if not mark:
        sys.exit(f"the page has no line {TABLES.strip()} in a section {name}")
    return "".join((before, heading, prose, mark, "\n", "\n".join(lines).rstrip("\n"), "\n", following, after))
