"""The accuracy with which stated start and tags determine the frame of a drive without a map of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from factorgraph_loc.evaluation.pairing import CONFIDENCE
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagReadCounts


@dataclass(frozen=True)
class FrameKnown:
    """The accuracy of the frame of a drive. ``nees``: the NEES of the stated start. ``least``: a lower bound of the root mean
    square error along the path [m]. It holds even if the shape of the path is exactly known."""

    nees: float
    least: float


def frame_known(log: Log) -> FrameKnown:
    """Return the accuracy of the frame of a simulated log.

    The lower bound is the Cramer-Rao bound of a pose that moves the whole path. The Fisher information is that of the stated
    start and of all inventory rounds at the true poses (van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968,
    section 2.4).
    """
    truth, start = log.reference, log.start
    assert truth is not None, "a log to score has a reference"
    assert start is not None, "a simulated log has a start"
    off = start.pose - truth.poses[0]
    off[2] = se2.wrap_scalar(off[2])
    tags = tag_map(log.world, log.rig.of(SurveySettings)).tags
    reads = RfidLikelihood(log.rig.of(RfidSettings).model(), tags)
    antennas = np.arange(len(reads.model.antennas))
    hits = np.zeros((len(antennas), len(tags.points)), dtype=np.int64)
    a_round = TagReadCounts(np.zeros((len(antennas), 3)), antennas, np.ones_like(antennas), hits)
    poses = np.vstack((truth.poses[0], truth.at(np.unique(log.streams["rfid"].t))))
    told = reads.score(poses, a_round).information
    told[0] = np.linalg.inv(se2.world_to_body(poses[0], np.diag(start.sigmas**2)))
    poses[:, :2] -= poses[:, :2].mean(axis=0)
    moved = se2.adjoint(se2.inverse(poses))
    spread = np.linalg.inv(np.einsum("nji,njk,nkl->il", moved, told, moved))
    turned = spread[2, 2] * np.mean(np.sum(poses[:, :2] ** 2, axis=1))
    return FrameKnown(float(np.sum((off / start.sigmas) ** 2)), float(np.sqrt(np.trace(spread[:2, :2]) + turned)))


def sentence(known: Sequence[FrameKnown]) -> str:
    """Return a text for the page about the errors of the starts of all drives and their lower bound."""
    count = len(known)
    tails = (1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0
    low, high = (chi2.ppf(tail, 3 * count) / count for tail in tails)
    least = np.sqrt(np.mean([one.least**2 for one in known]))
    return (
        f"The start poses have a mean NEES of {np.mean([one.nees for one in known]):.2f} (95 % interval for random errors: "
        f"{low:.2f} to {high:.2f}). With tags the final error is at least {least:.4f} m, even if the shape of the path is "
        "exactly known (Cramér-Rao bound)."
    )
