"""The report of an RFID calibration, as tables and plain values."""

from typing import Any

from factorgraph_loc.drawing.pages import Rows
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.learn import RfidKnowledge


def offsets_table(found: RfidKnowledge) -> Rows:
    """Changes of survey and mounting."""
    header = ("survey and mounting", "change", "standard error", "why")
    rows: list[tuple[str, ...]] = [
        (
            f"{o.what}.{o.name} [{'rad' if o.name in ('heading', 'yaw') else 'm'}]",
            f"{o.change:.4f}",
            f"{o.error:.4f}",
            o.why,
        )
        for o in found.offsets
    ]
    return header, rows


def models_table(found: RfidKnowledge, *, accepted: bool) -> Rows:
    """Detection models by their likelihood on held-out reads. ``accepted``: whether the rig has the best one."""
    header = ("model of detection", "smoothness", "held-out nats per round and tag", "worst fold", "")
    rows: list[tuple[str, ...]] = [
        (
            t.kind.label(),
            f"{t.kind.smoothness:g}" if t.kind.smoothness else "-",
            f"{t.nll:.4f}",
            f"{max(t.by_fold):.4f}",
            "" if t is not found.choice.best else "in the rig" if accepted else "rejected",
        )
        for t in found.choice.trials
    ]
    return header, rows


def tags_table(found: RfidKnowledge) -> Rows:
    """Tags that seem to be misplaced."""
    header = ("tag", "distance [m]", "x [m]", "y [m]", "chance in a correct map")
    rows: list[tuple[str, ...]] = [
        (d.name, f"{d.distance:.2f}", f"{d.shift[0]:.2f}", f"{d.shift[1]:.2f}", f"{d.p:.1g}") for d in found.doubts
    ]
    return header, rows


def tempering_text(found: RfidKnowledge, rig: Rig) -> str:
    """The correlation of reads, in two sentences."""
    assert rig.rfid is not None
    return (
        f"By their scatter along the reference, {1.0 / found.share:.0f} consecutive reads are worth one independent read. "
        f"The smoother is consistent with a tempering of {rig.rfid.tempering:.3g}, which the rig has."
    )


def dead_text(found: RfidKnowledge) -> str:
    """The share of dead tags, in a sentence."""
    return (
        f"The prior share of dead tags in the maps is {100.0 * found.dead.share:.1f} %; "
        f"{len(found.dead.tags)} were never read, of which {len(found.dead.believed)} should have been."
    )


def rfid_document(found: RfidKnowledge, *, accepted: bool) -> dict[str, Any]:
    """All figures as plain values; ``accepted``: see :func:`models_table`."""
    return {
        "offsets": [
            {
                "what": o.what,
                "name": o.name,
                "change": o.change,
                "standard_error": o.error,
                "kept": o.kept,
                "why": o.why,
            }
            for o in found.offsets
        ],
        "models": [
            {
                "model": t.kind.label(),
                "smoothness": t.kind.smoothness,
                "held_out_nll": t.nll,
                "by_fold": list(t.by_fold),
                "kept": accepted and t is found.choice.best,
            }
            for t in found.choice.trials
        ],
        "phase_agreement": None if found.phase is None else [found.phase.before, found.phase.after],
        "independent_share": found.share,
        "misplaced_tags": [{"tag": d.name, "x": d.shift[0], "y": d.shift[1], "p": d.p} for d in found.doubts],
        "silent_tags": list(found.dead.tags),
        "dead_share": found.dead.share,
        "dead_tags": dict(found.dead.tags),
    }
