"""``fgloc simulate``: logs that are made, not recorded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import DataRoot, Json, LogOptions, key_and_value
from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.seeds import parse_seeds
from factorgraph_loc.text import quoted

if TYPE_CHECKING:
    from factorgraph_loc.simulation import SimulationSettings


def simulate(
    what: Annotated[
        str,
        typer.Argument(
            metavar="PRESET",
            help=f"{', '.join(completion.PRESETS)}, or a TOML file.",
            autocompletion=completion.preset,
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FOLDER", help="To write; with --seeds, a folder of them.")
    ],
    seed: Annotated[
        int, typer.Option(min=0, help="Of everything that is drawn; the same seed gives the same bytes.")
    ] = 0,
    seeds: Annotated[
        str | None, typer.Option(metavar="A:B", help="A log of each seed from A to B-1, in FOLDER/NAME-SEED.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Of the drive [s]; that of the presets is 600.")
    ] = None,
    tags: Annotated[int | None, typer.Option(metavar="N", help="Number of tags.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting, e.g. faults.misplaced=0.1; may be repeated."),
    ] = None,
    recorded: Annotated[
        str | None,
        typer.Option(
            metavar="LOG",
            help="Draw each read from those of this recording, with its antennas (semi-real).",
            autocompletion=completion.logs,
        ),
    ] = None,
    images: Annotated[
        bool, typer.Option("--images", help="With what a camera sees: the building is rendered.")
    ] = False,
    image_rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Images per second; that of the presets is 5.")
    ] = None,
    world_seed: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="Of the world alone, for several drives through one; else --seed."),
    ] = None,
    data_root: DataRoot = None,
    json: Json = False,
) -> None:
    """Make logs with known truth: a world, a drive, and what odometry, RFID antennas and a camera report on it."""
    chosen = [seed] if seeds is None else list(parse_seeds(seeds))
    from factorgraph_loc import api
    from factorgraph_loc.files.models import file_name
    from factorgraph_loc.simulation import recorded_looks

    named = {"drive.duration": duration, "world.tags": tags, "images.rate": image_rate, "world_seed": world_seed}
    changes = nested_changes(named, set_ or [])
    if "images" in changes and not images:
        raise InputError("--image-rate or --set images.KEY tells how images are made, expected --images with it")
    settings = settings_of(what, changes)
    looks = None
    if recorded is not None:
        looks = recorded_looks(LogOptions(None, None, data_root, None, None).load([recorded]))
    written = []
    for number in chosen:
        folder = out if seeds is None else out / file_name(f"{settings.name}-{number}")
        with show.progress(folder.name, counted=True) as tell:
            log = api.simulate(settings, number, recorded=looks, images=images, out=folder, progress=tell)
        for warning in log.warnings:
            show.note(f"warning: {log.name}: {warning}")
        if not json:
            show.line(f"wrote {folder}")
        first, last = log.span()
        written.append({"log": log.name, "seed": number, "span": last - first, "folder": str(folder)})
    if json:
        show.document(written[0] if seeds is None else written)


def settings_of(what: str, changes: dict[str, Any]) -> SimulationSettings:
    """Those of a preset, or of a file where the name looks like one."""
    from factorgraph_loc.simulation import named_settings

    return named_settings(what, changes)


def nested_changes(named: dict[str, float | None], texts: list[str]) -> dict[str, Any]:
    """The options as nested tables; the named ones go before ``--set``."""
    changes: dict[str, Any] = {}
    pairs = [key_and_value(text, "--set") for text in texts]
    pairs += [(key, value) for key, value in named.items() if value is not None]
    for name, value in pairs:
        *tables, key = name.split(".")
        inner = changes
        for table in tables:
            inner = inner.setdefault(table, {})
            if not isinstance(inner, dict):
                raise InputError(f"--set is {name}={value}, but {table} is set to {quoted(inner)} already")
        inner[key] = value
    return changes
