"""Initial estimate of the tempering from the correlation of consecutive reads.

For independent reads the gradient of the log-likelihood by the pose has the Fisher information as covariance. The ratio of its
actual covariance over time windows to that is the overconfidence of the likelihood (Varin, Reid and Firth, "An overview of
composite likelihood methods", Statistica Sinica 21, 2011, section 2.2).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.fit import Floor
from factorgraph_loc.sensors.rfid.calibration.pairs import TagPairs, modelled, nearby, pairs_of, terms
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors import se2
from factors.rfid.model import DetectionModel
from factors.se2 import Array

WINDOW = 10.0  # s
LEAST = 1e-3  # of the tempering
_STEP = 1e-4  # m, rad; of numerical derivatives


def tempered(rig: Rig, factor: float) -> Rig:
    """The rig with RFID weighted as if standard deviations were ``factor`` times those of independent reads, at least 1."""
    assert rig.rfid is not None
    tempering = min(1.0, max(factor**-2.0, LEAST))
    return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"tempering": tempering})})


def bursts(pairs: TagPairs, logit: Array, floor: Floor) -> tuple[float, float]:
    """How many rounds are worth an independent one, at least 1, and its standard error: by the scatter of each tag's reads by each
    antenna in blocks of :data:`~factorgraph_loc.sensors.rfid.calibration.pairs.BLOCK` seconds, for a model with ``logit`` (M,).

    Unlike the gradient by the pose, this scatter hardly depends on trajectories that were found by the same reads. It is a ratio
    of variances (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5), with the error of a ratio over blocks.
    """
    p = floor.false_read + (1.0 - floor.false_read - floor.miss) / (1.0 + np.exp(-logit))
    key = (pairs.block * (pairs.tag.max() + 1) + pairs.tag) * (pairs.antenna.max() + 1) + pairs.antenna
    _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    excess, variance = np.bincount(cell, pairs.hits - pairs.count * p), np.bincount(cell, pairs.count * p * (1.0 - p))
    block = pairs.block[first]
    observed, expected = np.bincount(block, excess**2), np.bincount(block, variance)
    ratio = float(observed.sum() / max(float(expected.sum()), 1e-9))
    error = float(np.sqrt(np.sum((observed - ratio * expected) ** 2)) / max(float(expected.sum()), 1e-9))
    return max(1.0, ratio), error


def independent_share(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
) -> float:
    """The exponent, at most 1, at which the likelihood of unmerged rounds matches their scatter along the reference."""
    outer, information = np.zeros((3, 3)), np.zeros((3, 3))
    for log in logs:
        within = [nearby(log, settings, survey)]
        pairs = pairs_of([log], settings, survey, within)
        here = modelled(models, which, pairs)
        moved = [replace(log, poses=se2.compose(log.poses, e)) for e in _STEP * np.eye(3)]
        jacobian = np.column_stack(
            [(modelled(models, which, pairs_of([one], settings, survey, within)) - here) / _STEP for one in moved]
        )
        found = terms(here, pairs.hits, pairs.count, floor.false_read, floor.miss)
        window = ((log.t - log.t.min()) // WINDOW).astype(np.int64)[within[0] // len(log.names)]
        scores = np.zeros((int(window.max()) + 1, 3))
        np.add.at(scores, window, found.gradient[:, None] * jacobian)
        outer += scores.T @ scores
        information += jacobian.T @ (found.information[:, None] * jacobian)
    return float(np.clip(3.0 / np.trace(np.linalg.solve(information, outer)), LEAST, 1.0))
