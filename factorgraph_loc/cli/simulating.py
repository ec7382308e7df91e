"""``fgloc simulate``: simulated logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json, nested_changes
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.scoring import parse_seeds
from factorgraph_loc.plugins import PRESETS

OutFolder = Annotated[
    Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to write; with --seeds, a folder of folders.")
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
        raise InputError("--set images.KEY configures images, expected --images with it")
    settings = named_settings(what, changes)
    written = []
    for number in chosen:
        folder = out if seeds is None else out / file_name(f"{settings.name}-{number}")
        with show.progress(folder.name, counted=True) as report:
            log = logs.simulate(settings, number, images=images, out=folder, progress=report)
        for warning in log.warnings:
            show.note(f"warning: {log.name}: {warning}")
        if not json:
            show.line(f"wrote {folder}")
        first, last = log.span()
        written.append({"log": log.name, "seed": number, "span": last - first, "folder": str(folder)})
    if json:
        show.document(written[0] if seeds is None else written)
