"""How far results may be from those that are held: on this machine, on another processor, and where a last bit decides."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factors import se2
from regression.differences import Difference, differences
from regression.records import Record

SAME = 1e-9  # on one machine, with the same arithmetic
TOLERANCE = 1e-6  # between processors, where nothing branches


@dataclass(frozen=True)
class Branch:
    """Why the last bits of its numbers decide what a case does, and how far another processor's results may then be off.

    ``loose``: by quantity, of numbers as of :func:`regression.differences.size_of`, but of poses beside covariances in units of
    the stored standard deviations; infinite for what is not held at all. ``tolerance``: of all other numbers.
    """

    reason: str
    loose: Mapping[str, float] = field(default_factory=dict)
    tolerance: float = TOLERANCE

    def allows(self, difference: Difference, old: Record, new: Record) -> bool:
        """Whether a difference is no larger than that."""
        bound = self.loose.get(difference.quantity, self.tolerance)
        size, (kind, _, what) = difference.size, difference.quantity.rpartition(".")
        if (
            difference.quantity in self.loose
            and what == "poses"
            and f"{kind}.covariances" in old.numbers
            and np.isfinite(size)
        ):
            size = _in_sigmas(kind, old, new)
        return size <= bound


NOT_HELD = math.inf
# The bounds are two to three times what was measured with the kernels Haswell, Prescott and SkylakeX of the BLAS library, with
# numba for a generic processor, and on processors of two makers.
DRAWN = Branch(
    "Final trajectories are drawn backwards by eigenvectors of covariances, whose signs another kernel of the BLAS library turns.",
    {"final.poses": 0.7, "final.covariances": 1.6},
)
SINGLE_PRECISION = Branch(
    "Particles are weighed by tables of tags in single precision, whose last bits decide which are resampled.",
    {
        **{"causal.poses": 1.2, "causal.covariances": 1.2, "final.poses": 1.2, "final.covariances": 1.8},
        **{
            "learnt.constants": 1.0,
            "belief": NOT_HELD,
            "belief.poses": 0.1,
            "belief.weights": 0.1,
            "nis.rfid.sums": 0.1,
            "dead_tags.probabilities": 0.01,
        },
        **dict.fromkeys(("moved_tags", "moved_tags.probabilities", "warnings"), NOT_HELD),
        **{f"{kind}.sums": 0.01 for kind in ("nis.bearing_range", "residuals.bearing_range.range")},
        "residuals.bearing_range.bearing.sums": 0.01,
    },
)
MANY_OPTIMA = Branch(
    SINGLE_PRECISION.reason + " Phase has many optima, and particles stay in one or another of them.",
    {**SINGLE_PRECISION.loose, "learnt.constants": 2.5},
)
WHEN_FOUND = {
    **dict.fromkeys(("status", "nis", "nis.rfid.t", "nis.rfid.sums", "residuals"), NOT_HELD),
    "events.t": 0.4,
}
FOUND_BY_PARTICLES = Branch(
    SINGLE_PRECISION.reason + " So the place is found some ticks earlier or later.",
    {**SINGLE_PRECISION.loose, **WHEN_FOUND, "causal.poses": 6.0, "final.poses": 6.0, "final.covariances": 5.0},
)
FOUND = Branch(
    FOUND_BY_PARTICLES.reason,
    {
        **{"causal.poses": 1.2, "causal.covariances": 1.2, "final.poses": 0.05, "final.covariances": 0.015},
        **{"learnt.constants": 0.04, "belief.poses": NOT_HELD, "belief.weights": 0.1},
        **WHEN_FOUND,
    },
)
UNDECIDED = Branch(
    "Many places explain what was seen equally well: which of them a search keeps, and in which order, is left to rounding.",
    {
        **dict.fromkeys(("belief", "belief.weights", "belief.poses", "causal.poses", "causal.covariances"), NOT_HELD),
        **WHEN_FOUND,
        **{"events.t": 1.5, "final.poses": 2.0},
    },
    0.2,
)
ILL_CONDITIONED = Branch(
    "The camera's constants can hardly be told apart by now, and rounding is amplified as often as they are linearised anew.",
    tolerance=1e-4,
)
FAR_OFF = Branch(
    "Glitches of metres lead far from the truth, where nothing that is seen fits, and linearisation amplifies rounding.",
    tolerance=1e-2,
)
STOPPED_FAR_OFF = Branch(
    FAR_OFF.reason + " Where the descent from there ends, a metre or two from elsewhere, is left to rounding.",
    {"warnings": NOT_HELD, "final.covariances": 15.0},
    1.0,
)
GATED = Branch(
    "Rows that are missing or come twice make landmarks lie at the edge of what is believed: the last bits decide which are, and "
    "whether a track is given up.",
    {
        "final.poses": 40.0,
        **dict.fromkeys(
            ("events", "events.t", "moved_tags", "moved_tags.probabilities", "warnings", "final.covariances"), NOT_HELD
        ),
    },
    10.0,
)
SUMS = tuple(
    f"{what}.sums"
    for what in ("nis.rfid", "nis.bearing_range", "residuals.bearing_range.range", "residuals.bearing_range.bearing")
)
FEW_PARTICLES = Branch(
    SINGLE_PRECISION.reason
    + " Landmarks are far more exact than tags, so that few particles are left of each of them.",
    {
        **SINGLE_PRECISION.loose,
        **WHEN_FOUND,
        **dict.fromkeys(SUMS, 1.5),
        **{"learnt.constants": 5.0, "causal.poses": 8.0, "final.poses": 8.0, "final.covariances": 15.0},
    },
)
UNDECIDED_BY_PARTICLES = Branch(
    UNDECIDED.reason + " Particles of one of them may die out, the right one or another.",
    {
        **FEW_PARTICLES.loose,
        **UNDECIDED.loose,
        **dict.fromkeys(
            (
                *SUMS,
                "nis.bearing_range.t",
                "final.poses",
                "final.covariances",
                "learnt.constants",
                "events",
                "events.t",
            ),
            NOT_HELD,
        ),
    },
)
CHOSEN = Branch(
    SINGLE_PRECISION.reason + " So is the way that is chosen, and from there on everything is another run.",
    dict.fromkeys(
        (
            *("truth.poses", "steps.poses", "steps.covariances", "steps.particles.sums", "steps.chosen.poses"),
            *("steps.t", "steps.values", "candidates"),
        ),
        NOT_HELD,
    ),
)


def branch_of(case: str) -> Branch | None:
    """That of a case ``SCENARIO/LABEL``."""
    name, _, label = case.partition("/")
    if label == "log":
        return None
    particles = label.startswith("particle_filter")
    hears_tags = name.startswith(("tags", "recorded-tags", "fault"))
    if name.startswith("active"):
        found = CHOSEN
    elif name == "tags-landmarks-undecided" and not particles:
        found = UNDECIDED
    elif name in ("tags-unknown-start", "tags-unknown-heading", "tags-kidnapped", "tags-landmarks-unknown-start"):
        found = FOUND_BY_PARTICLES if particles or label == "switching" else FOUND
        found = FEW_PARTICLES if case == "tags-landmarks-unknown-start/particle_filter" else found
    elif name == "tags-landmarks-undecided":
        found = UNDECIDED_BY_PARTICLES
    elif particles and name.startswith(("fault", "tags-landmarks")):
        found = FEW_PARTICLES
    elif hears_tags and (particles or label == "switching"):
        found = MANY_OPTIMA if particles and name == "tags-phase" else SINGLE_PRECISION
    elif particles:
        found = DRAWN
    elif name == "points-self-calibration" and label.startswith("smoother"):
        found = ILL_CONDITIONED
    elif name == "fault-many-glitches" and label in ("smoother", "batch"):
        found = FAR_OFF if label == "smoother" else STOPPED_FAR_OFF
    elif name in ("fault-repeated-rows", "fault-missing-rows") and label in ("smoother", "batch"):
        found = GATED
    else:
        return None
    return found


def beyond(old: Record, new: Record, tolerance: float) -> list[Difference]:
    """What differs by more than a tolerance."""
    return [d for d in differences(old, new) if d.size > tolerance]


def beyond_processors(case: str, old: Record, new: Record) -> list[Difference]:
    """What differs by more than processors make results of a case differ."""
    branch = branch_of(case)
    return [d for d in beyond(old, new, TOLERANCE) if branch is None or not branch.allows(d, old, new)]


def _in_sigmas(kind: str, old: Record, new: Record) -> float:
    """The largest difference of poses in units of their standard deviations."""
    poses, covariances = old.numbers[f"{kind}.poses"], old.numbers[f"{kind}.covariances"]
    difference = new.numbers[f"{kind}.poses"] - poses
    difference[:, 2] = se2.wrap(difference[:, 2])
    return float(np.nanmax(np.abs(difference) / np.sqrt(covariances[:, (0, 3, 5)])))
