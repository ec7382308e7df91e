"""The commands ``fgloc datasets``, ``info``, ``manifest``, ``convert`` and ``simulate``, which list, summarize,
describe, convert and simulate logs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import DataRoot, Json, LogName, LogOptions, nested_changes, takes_options
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.scoring import parse_seeds
from factorgraph_loc.plugins import PRESETS
from factorgraph_loc.text import number, one_line

if TYPE_CHECKING:
    from factorgraph_loc.evaluation.inspect import Inspection, StreamSummary
    from factorgraph_loc.io.bags.manifest import TopicUse
    from factorgraph_loc.model.log import Log


def datasets(data_root: DataRoot = None, json: Json = False) -> None:
    """List the logs that are known by name, and whether their files exist.

    Example: fgloc datasets
    """
    from factorgraph_loc.io.readers import describe

    known = [asdict(dataset) for dataset in describe(data_root)]
    if json:
        show.document(known)
        return
    rows = [(d["name"], d["reader"], "yes" if d["present"] else "no", d["title"]) for d in known]
    show.table(("name", "reader", "present", "title"), rows)


@takes_options
def info(
    log: LogName,
    *,
    source: LogOptions,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="PNG file for a plot of the log from above; not of a ROS bag."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Summarize a log, with warnings about its content. For a ROS bag, list the topics.

    Example: fgloc info monday.toml -o monday.png
    """
    from factorgraph_loc.api.logs import draw
    from factorgraph_loc.evaluation.inspect import inspect
    from factorgraph_loc.files.shipped import manifests
    from factorgraph_loc.io.bags.file import is_bag
    from factorgraph_loc.io.readers import read_manifest, verify

    if source.reader is None and is_bag(Path(log)) and Path(log).exists():
        info_of_bag(Path(log), json)
        return
    known = manifests()
    if source.reader is None and log in known:
        for fault in verify(read_manifest(known[log]), source.data_root):
            show.note(f"warning: {fault}")
    logs = source.load([log])
    if out is not None:
        draw(logs, out)
    inspections = [inspect(loaded) for loaded in logs]
    if json:
        documents = [_document(loaded, inspection) for loaded, inspection in zip(logs, inspections, strict=True)]
        show.document(documents[0] if len(documents) == 1 else documents)
        return
    for i, (loaded, inspection) in enumerate(zip(logs, inspections, strict=True)):
        if i:
            show.line()
        _print(loaded, inspection)
    if out is not None:
        show.line()
        show.line(f"wrote {out}")


@takes_options
def convert(
    log: LogName,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write.")],
    format: Annotated[Literal["csv", "parquet"], typer.Option(help="Format of the tables.")] = "csv",
    *,
    source: LogOptions,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log in the folder OUT.")] = False,
    json: Json = False,
) -> None:
    """Write a log as a folder in the native format.

    Example: fgloc convert monday.toml out/monday
    """
    from factorgraph_loc.api import logs

    loaded = source.load_one(log)
    show.warnings(loaded.warnings)
    logs.convert(loaded, out, format=format, overwrite=overwrite)
    if json:
        names = sorted(path.name for path in out.iterdir())
        show.document({"log": loaded.name, "folder": str(out), "files": names})
    else:
        show.line(f"wrote {out}")


def _print(log: Log, inspection: Inspection) -> None:
    first, last = log.span()
    about = {
        "log": log.name,
        "span": f"{last - first:.1f} s",
        "rig": f"{log.rig.name}, sensors {', '.join(log.rig.sensors) or 'none'}",
        "world": ", ".join([log.world.name, *(f"{count} {layer}" for layer, count in inspection.in_map.items())]),
        "start": "given by the log" if log.start is not None else "not given",
    }
    if log.reference is None:
        about["reference"] = "none: runs cannot be scored"
    elif not log.reference.has_heading:
        about["reference"] = "positions only, headings are not scored"
    show.fields(about | dict(log.metadata))
    show.line()
    streams = dict(inspection.streams)
    if inspection.reference is not None:
        streams["reference"] = inspection.reference
    header = ("stream", "rows", "rate [Hz]", "first [s]", "last [s]", "gaps")
    show.table(header, [_row(name, stream) for name, stream in streams.items()])
    show.line()
    for paragraph in (p for summary in inspection.sensors.values() for p in summary.text):
        show.line(paragraph.line)
        if paragraph.header:
            show.table(paragraph.header, paragraph.rows)
        show.line()
    if not inspection.problems:
        show.line("no warnings")
    for problem in inspection.problems:
        show.line(f"! {one_line(str(problem))}")


def _row(name: str, stream: StreamSummary) -> tuple[str, ...]:
    numbers = (number(stream.rate, 1), number(stream.first, 1), number(stream.last, 1))
    return (name, str(stream.rows), *numbers, str(len(stream.gaps)))


def _document(log: Log, inspection: Inspection) -> dict[str, Any]:
    first, last = log.span()
    return {
        "log": log.name,
        "metadata": dict(log.metadata),
        "span": last - first,
        "rig": log.rig.model_dump(mode="json", exclude_none=True),
        "world": {"name": log.world.name, **inspection.in_map},
        "start": None if log.start is None else {"t": log.start.t, "pose": log.start.pose.tolist()},
        "streams": inspection.streams,
        "reference": inspection.reference,
        **inspection.found,
        "problems": [one_line(str(problem)) for problem in inspection.problems],
    }


def manifest(
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="A folder of tables, a .bag, .mcap or .db3, or the folder of a ROS 2 bag."),
    ],
    json: Json = False,
) -> None:
    """Propose a manifest, which assigns the files of a folder, or the topics of a ROS bag, to sensors. Save and check the output.

    Example: fgloc manifest monday > monday.toml; fgloc info monday.toml
    """
    from factorgraph_loc.api.logs import manifest

    proposal = manifest(log)
    if proposal.folder != Path.cwd().resolve():
        name = proposal.content["path"]
        show.note(
            f"the path {name} in the manifest is relative: save the manifest in {proposal.folder}, "
            f"or give --data-root {proposal.folder}"
        )
    if json:
        show.document({"manifest": proposal.content, "remarks": proposal.remarks})
    else:
        show.lines(proposal.text.rstrip("\n"))


def info_of_bag(bag: Path, json: Json) -> None:
    """Print the topics of a ROS bag as a table, or as JSON if ``json`` is set."""
    from factorgraph_loc.io.bags.manifest import manifest_of_bag

    proposal = manifest_of_bag(bag, Path.cwd())
    if json:
        show.document({"bag": str(bag), "duration": proposal.duration, "topics": proposal.topics})
        return
    show.fields({"bag": str(bag), "duration": f"{proposal.duration:.1f} s"})
    show.line()
    header = ("topic", "type", "messages", "rate [Hz]", "looks like")
    show.table(header, [_topic_row(topic) for topic in proposal.topics])
    show.line()
    show.line(f"`fgloc manifest {bag} > run.toml` proposes a manifest; then `fgloc info run.toml` shows the content")


def _topic_row(t: TopicUse) -> tuple[str, ...]:
    return (t.topic, t.type, str(t.messages), "" if t.rate is None else f"{t.rate:.1f}", t.use or "")


OutFolder = Annotated[
    Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to write; with --seeds, one folder per log in it.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A setting, e.g. faults.misplaced=0.1; `fgloc presets NAME` lists them. May be repeated.",
        autocompletion=completion.simulation_setting,
    ),
]


def simulate(
    what: Annotated[
        str,
        typer.Argument(
            metavar="PRESET", help=f"{', '.join(PRESETS)}, or a TOML file.", autocompletion=completion.preset
        ),
    ],
    out: OutFolder,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random draws; the same seed gives the same bytes.")] = 0,
    seeds: Annotated[
        str | None, typer.Option(metavar="A:B", help="One log for each seed from A to B-1, in FOLDER/NAME-SEED.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Duration of the drive [s]; 600 in the presets.")
    ] = None,
    set_: Changes = None,
    images: Annotated[bool, typer.Option("--images", help="Also render camera images.")] = False,
    json: Json = False,
) -> None:
    """Simulate logs with known ground truth: a world, a drive, and the measurements of odometry, RFID antennas and camera.

    Example: fgloc simulate office --duration 60 -o out/office
    """
    chosen = [seed] if seeds is None else list(parse_seeds(seeds))
    from factorgraph_loc.api import logs
    from factorgraph_loc.files.models import file_name
    from factorgraph_loc.simulation import named_settings

    drive = () if duration is None else (f"drive.duration={duration}",)
    changes = nested_changes((*(set_ or ()), *drive))
    if "images" in changes and not images:
        raise InputError("--set images.KEY has no effect without --images: add --images")
    settings = named_settings(what, changes)
    written = []
    for drawn in chosen:
        folder = out if seeds is None else out / file_name(f"{settings.name}-{drawn}")
        with show.progress(folder.name, counted=True) as report:
            log = logs.simulate(settings, drawn, images=images, out=folder, progress=report)
        for warning in log.warnings:
            show.note(f"warning: {log.name}: {warning}")
        if not json:
            show.line(f"wrote {folder}")
        first, last = log.span()
        written.append({"log": log.name, "seed": drawn, "span": last - first, "folder": str(folder)})
    if json:
        show.document(written[0] if seeds is None else written)
