"""The output of ``fgloc map``: tables, lines and the JSON document."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from factorgraph_loc.cli import show

if TYPE_CHECKING:
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.point_mapping import PointReport
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    Made = LandmarkMap | MadeTags | PointReport | DroppedTags

COLUMNS = ("given x [m]", "y [m]", "learnt x [m]", "y [m]", "sigma [m]", "distance [m]", "verdict")


def tell(found: Made) -> tuple[str, ...]:
    """Print the table of map elements, if any, and return further lines."""
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(found, DroppedTags):
        if found.dropped:
            _table(("dropped tag", "P(dead)"), [(name, f"{dead:.4f}") for name, dead in found.dropped.items()])
        count = len(found.dropped)
        return (f"believed dead and not in the new map: {count} of {count + found.kept} tags",)
    if isinstance(found, LandmarkMap):
        _table(("landmark", *COLUMNS), _rows(found, {}))
        return (found.summary(), *found.notes)
    if isinstance(found, MadeTags):
        _table(("tag", *COLUMNS), _rows(found.made, found.open))
        return (found.made.summary("tags"), *_notes(found))
    return (
        f"{found.points} points are in the new map, with {found.observations} observations in {found.keyframes} keyframes",
        f"reprojection residual: {found.rms:.2f} px root mean square, {found.mad:.2f} px median",
        f"parallax {found.parallax:.3f} rad, standard deviation in the worst direction {found.sigma:.3f} m (medians)",
        f"the cameras were moved by {found.shifted:.3f} m and {found.turned:.4f} rad (medians)",
    )


def document(found: Made) -> dict[str, Any]:
    """All figures as plain values."""
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(found, LandmarkMap):
        landmarks = [{"landmark": name} | entry for name, entry in _entries(found, {}).items()]
        return {"landmarks": landmarks, "summary": found.summary(), "notes": [*found.notes]}
    if not isinstance(found, MadeTags):
        return asdict(found)
    facing = {name: tag.facing for name, tag in found.world.tags.items()}
    entries = _entries(found.made, found.open)
    modes = {
        name: [{"weight": m.weight, "position": m.position.tolist()} for m in modes]
        for name, modes in found.modes.items()
    }
    return {
        "tags": [{"tag": name, "facing": facing.get(name)} | entry for name, entry in entries.items()],
        "not_located": dict(found.open),
        "modes": modes,
        "rms": math.nan if found.rms is None else found.rms,
        "summary": found.made.summary("tags"),
        "notes": _notes(found),
    }


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    show.table(header, rows)
    show.line()


def _rows(made: LandmarkMap, verdicts: Mapping[str, str]) -> list[tuple[str, ...]]:
    rows = []
    for name, entry in _entries(made, verdicts).items():
        places = (*(entry["given"] or (None, None)), *(entry["learnt"] or (None, None)))
        numbers = (show.number(value) for value in (*places, entry["sigma"], entry["distance"]))
        rows.append((name, *numbers, entry["verdict"]))
    return rows


def _entries(made: LandmarkMap, verdicts: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """The entry of each landmark or tag; ``verdicts`` replace some of the map's."""
    return {
        entry.landmark: {
            "given": None if entry.given is None else entry.given.tolist(),
            "learnt": None if entry.learnt is None else entry.learnt.position.tolist(),
            "covariance": None if entry.learnt is None else entry.learnt.covariance.tolist(),
            "sigma": entry.sigma,
            "distance": entry.distance,
            "verdict": verdicts.get(entry.landmark, entry.verdict),
            "flagged": entry.flagged,
        }
        for entry in made.entries
    }


def _notes(made: MadeTags) -> list[str]:
    """Lines on what the table does not show: unmapped tags, and the RMS distance from the given positions."""
    listed = {entry.landmark for entry in made.made.entries}
    others = {name: why for name, why in made.open.items() if name not in listed}
    told = [note for note in made.made.notes if not note.startswith("kept as they are")]
    kept = [name for name in made.open if name in made.world.tags]
    if kept:
        told.append(f"kept unchanged from the given map, as they could not be located: {', '.join(kept)}")
    silent = [name for name, why in made.open.items() if why == "never read"]
    if silent:
        told.append(f"never read: {', '.join(silent)}")
    if made.rms is not None:
        told.append(f"root mean square distance from the given positions: {made.rms:.3f} m")
    chance = [name for name, why in others.items() if "than chance" in why]
    if chance:
        told.append(
            f"{len(chance)} tags that the map lacks were read so rarely that no position explains the reads better than chance"
        )
    return told + [f"not in the map: {name}, {why}" for name, why in others.items() if name not in chance]
