"""``fgloc manifest``, and the topics of a ROS bag for ``fgloc info``."""

import os
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json

BagPath = Annotated[Path, typer.Argument(metavar="BAG", help="A .bag, .mcap or .db3, or the folder of a ROS 2 bag.")]


def manifest(bag: BagPath, json: Json = False) -> None:
    """Propose a manifest for a ROS bag: which topic is which sensor. Write it to a file and check it."""
    from factorgraph_loc.io.bags.file import open_bag
    from factorgraph_loc.io.bags.manifest import manifest_of, manifest_text, propose, remarks

    path, here = Path(os.path.realpath(bag)), Path.cwd().resolve()
    below = path.is_relative_to(here)
    root = here if below else path.parent
    with open_bag(path) as opened:
        stem = path.with_suffix("") if path.is_file() else path
        beside = {
            kind: (file.relative_to(root)).as_posix()
            for kind in ("rig", "world")
            if (file := stem.with_name(f"{stem.name}.{kind}.toml")).is_file()
        }
        proposal = propose(opened)
        content = manifest_of(proposal, path.relative_to(root).as_posix(), beside)
        told = remarks(opened, proposal, beside)
    if not below:
        show.note(f"the manifest names {path.name} only: save it in {path.parent}, or give --data-root {path.parent}")
    if json:
        show.document({"manifest": content, "remarks": told})
    else:
        show.lines(manifest_text(content, told).rstrip("\n"))


def info_of_bag(bag: Path, json: Json) -> None:
    """Print the topics of a bag."""
    from factorgraph_loc.io.bags.file import open_bag
    from factorgraph_loc.io.bags.manifest import propose

    with open_bag(bag) as opened:
        uses = propose(opened).uses
        duration = opened.duration
        topics = list(opened.topics.values())
    rates = {t.name: (t.count - 1) / duration if duration > 0.0 and t.count > 1 else None for t in topics}
    if json:
        rows = [
            {"topic": t.name, "type": t.type, "messages": t.count, "rate": rates[t.name], "use": uses.get(t.name)}
            for t in topics
        ]
        show.document({"bag": str(bag), "duration": duration, "topics": rows})
        return
    show.fields({"bag": str(bag), "duration": f"{duration:.1f} s"})
    show.line()
    header = ("topic", "type", "messages", "rate [Hz]", "looks like")
    show.table(header, [_row(t.name, t.type, t.count, rates[t.name], uses.get(t.name, "")) for t in topics])
    show.line()
    show.line(f"`fgloc manifest {bag} > run.toml` proposes a manifest; then `fgloc info run.toml` shows the content")


def _row(name: str, kind: str, count: int, rate: float | None, use: str) -> tuple[str, ...]:
    return (name, kind, str(count), "" if rate is None else f"{rate:.1f}", use)
