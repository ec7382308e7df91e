"""What ``fgloc map`` tells of RFID tags."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from factorgraph_loc.cli import show

if TYPE_CHECKING:
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.tag_mapping import MadeTags

HEADER = ("tag", "given x [m]", "y [m]", "learnt x [m]", "y [m]", "sigma [m]", "distance [m]", "verdict")


def rows(made: MadeTags) -> list[tuple[str, ...]]:
    lines = []
    for entry in made.made.entries:
        given = (None, None) if entry.given is None else entry.given
        learnt = (None, None) if entry.learnt is None else entry.learnt.position
        numbers = (*given, *learnt, entry.sigma, entry.distance)
        verdict = made.open.get(entry.landmark, entry.verdict)
        lines.append((entry.landmark, *(show.number(value) for value in numbers), verdict))
    return lines


def notes(made: MadeTags) -> list[str]:
    """What the table does not tell: the tags that are in no map, and how far the others are off."""
    listed = {entry.landmark for entry in made.made.entries}
    others = {name: why for name, why in made.open.items() if name not in listed}
    told = [note for note in made.made.notes if not note.startswith("kept as they are")]
    kept = [name for name in made.open if name in made.world.tags]
    if kept:
        told.append(f"kept as they are in the given map, as they could not be located: {', '.join(kept)}")
    silent = [name for name, why in made.open.items() if why == "never read"]
    if silent:
        told.append(f"never read: {', '.join(silent)}")
    if made.rms is not None:
        told.append(f"root mean square distance from the given places: {made.rms:.3f} m")
    chance = [name for name, why in others.items() if "than chance" in why]
    if chance:
        told.append(
            f"{len(chance)} tags that the map lacks were read so seldom that no place explains it better than chance"
        )
    return told + [f"not in the map: {name}, {why}" for name, why in others.items() if name not in chance]


def tell_dropped(found: DroppedTags) -> tuple[str, ...]:
    """Print the tags that are dropped, and return what there is to say of them."""
    if found.dropped:
        show.table(("dropped tag", "P(dead)"), [(name, f"{dead:.4f}") for name, dead in found.dropped.items()])
        show.line()
    count = len(found.dropped)
    return (f"believed dead and not in the new map: {count} of {count + found.kept} tags",)


def document(made: MadeTags) -> dict[str, Any]:
    tags = []
    for entry in made.made.entries:
        written = made.world.tags.get(entry.landmark)
        tags.append(
            {
                "tag": entry.landmark,
                "given": None if entry.given is None else entry.given.tolist(),
                "learnt": None if entry.learnt is None else entry.learnt.position.tolist(),
                "covariance": None if entry.learnt is None else entry.learnt.covariance.tolist(),
                "facing": None if written is None else written.facing,
                "sigma": entry.sigma,
                "distance": entry.distance,
                "verdict": made.open.get(entry.landmark, entry.verdict),
                "flagged": entry.flagged,
            }
        )
    modes = {
        name: [{"weight": m.weight, "position": m.position.tolist()} for m in modes]
        for name, modes in made.modes.items()
    }
    return {
        "tags": tags,
        "not_located": dict(made.open),
        "modes": modes,
        "rms": math.nan if made.rms is None else made.rms,
        "summary": made.made.summary("tags"),
        "notes": notes(made),
    }
