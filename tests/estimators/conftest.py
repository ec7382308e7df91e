"""A simulated run whose noise is that of its rig."""

from collections.abc import Callable

import landmark_world
import pytest

from factorgraph_loc.model.log import Log


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Log]:
    """See :func:`landmark_world.simulate`."""
    return landmark_world.simulate
