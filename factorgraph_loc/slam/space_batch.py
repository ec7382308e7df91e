"""Batch estimation in space: all poses at once, at the end. Causal estimates are those of the filter that provides initial values;
they are not the batch's, and never ``localized``."""

from dataclasses import replace

from factorgraph_loc.model.belief import PoseEstimate
from factorgraph_loc.slam.space_graph import SpaceGraph, SpaceGraphSettings


class SpaceBatchSettings(SpaceGraphSettings):
    """Settings of the filter that provides initial values; ``landmarks`` must be ``known``, and ``planar`` off."""


class SpaceBatch(SpaceGraph):
    """Robust optimum over the whole log in space, for a camera that is carried by hand. See the module."""

    name = "space_batch"
    causal = False

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The filter's estimate, which is not to be scored: the problem is solved at the end only."""
        return replace(super().estimate(t), status="unlocalized")
