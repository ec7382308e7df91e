"""``fgloc manifest``, and the topics of a ROS bag for ``fgloc info``."""

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json

BagPath = Annotated[Path, typer.Argument(metavar="BAG", help="A .bag, .mcap or .db3, or the folder of a ROS 2 bag.")]


def manifest(bag: BagPath, json: Json = False) -> None:
    """Propose a manifest for a ROS bag: which topic is which sensor. Write it to a file and check it."""
    from factorgraph_loc.io.bags.proposed import manifest_of_bag

    found = manifest_of_bag(bag, Path.cwd())
    if found.folder != Path.cwd().resolve():
        name = found.content["path"]
        show.note(f"the manifest names {name} only: save it in {found.folder}, or give --data-root {found.folder}")
    if json:
        show.document({"manifest": found.content, "remarks": found.remarks})
    else:
        show.lines(found.text.rstrip("\n"))


def info_of_bag(bag: Path, json: Json) -> None:
    """Print the topics of a bag."""
    from factorgraph_loc.io.bags.proposed import manifest_of_bag

    found = manifest_of_bag(bag, Path.cwd())
    if json:
        show.document({"bag": str(bag), "duration": found.duration, "topics": found.topics})
        return
    show.fields({"bag": str(bag), "duration": f"{found.duration:.1f} s"})
    show.line()
    header = ("topic", "type", "messages", "rate [Hz]", "looks like")
    show.table(header, [_row(t.topic, t.type, t.messages, t.rate, t.use, t.unused) for t in found.topics])
    show.line()
    show.line(f"`fgloc manifest {bag} > run.toml` proposes a manifest; then `fgloc info run.toml` shows the content")


def _row(name: str, kind: str, count: int, rate: float | None, use: str | None, unused: str | None) -> tuple[str, ...]:
    told = use or (f"{unused}, not used" if unused else "")
    return (name, kind, str(count), "" if rate is None else f"{rate:.1f}", told)
