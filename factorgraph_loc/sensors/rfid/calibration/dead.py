"""The share of dead tags in a map: tags that are never read along the references although they should have been.

The detection model along the reference tells how likely a working tag would have been missed. The share maximises the posterior of
a mixture, by EM (Dempster, Laird, Rubin, JRSS B 39(1), 1977), with a prior worth :data:`PRIOR_TAGS` tags of the usual share.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factors.rfid.detection import RfidLikelihood
from factors.rfid.tag_states import BELIEVED

PRIOR_TAGS = 20.0
LARGEST = 0.45
ITERATIONS = 200


@dataclass(frozen=True)
class DeadTags:
    """``share``: of dead tags; ``tags``: those without reads in any log, with the probability that they are dead."""

    share: float
    tags: Mapping[str, float]

    @property
    def believed(self) -> tuple[str, ...]:
        """Tags that are more likely dead than not, most certain first."""
        found = [name for name, dead in self.tags.items() if dead > BELIEVED]
        return tuple(sorted(found, key=lambda name: -self.tags[name]))


def dead_tags(logs: Sequence[Log], rounds: Sequence[Rounds], rig: Rig) -> DeadTags:
    """The share of dead tags in the maps of logs, with their ``rounds`` along the references and the model of ``rig``.

    A name with two positions counts as two tags.
    """
    assert rig.rfid is not None
    silence: dict[tuple[str, float, float], float] = {}
    read: set[tuple[str, float, float]] = set()
    for log, one in zip(logs, rounds, strict=True):
        places = {name: (name, tag.x, tag.y) for name, tag in log.world.tags.items()}
        read |= {places[name] for name in one.names}
        found = tag_map(log.world, rig.survey, one.silent)
        likelihood = RfidLikelihood(rig.rfid.model(), found.tags)
        floor = np.log1p(-likelihood.probabilities(np.full((1, 3), 1e9), 0))
        total = np.zeros(len(found.names))
        for antenna in np.unique(one.antenna).tolist():
            mine = one.antenna == antenna
            missed = np.log1p(-np.minimum(likelihood.probabilities(one.poses[mine], antenna), 1.0 - 1e-12))
            total -= rig.rfid.tempering * (one.count[mine] @ (missed - floor))
        for name, value in zip(found.names, total.tolist(), strict=True):
            silence[places[name]] = silence.get(places[name], 0.0) + value
    unread = {key: value for key, value in silence.items() if key not in read}
    alive = np.exp(-np.array(list(unread.values())))
    usual = RfidSettings.model_fields["dead_tags"].default
    share, dead = usual, np.zeros(len(unread))
    for _ in range(ITERATIONS):
        dead = share / (share + (1.0 - share) * alive)
        share = float((dead.sum() + PRIOR_TAGS * usual) / (len(unread) + len(read) + PRIOR_TAGS))
    probabilities = dict(zip((name for name, _, _ in unread), dead.tolist(), strict=True))
    return DeadTags(round(min(share, LARGEST), 4), probabilities)
