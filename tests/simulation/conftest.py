"""One simulated log that several tests look at, and a way to make small ones."""

from collections.abc import Callable

import pytest

from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation import preset, simulate

Make = Callable[..., Log]


@pytest.fixture(scope="session")
def office() -> Log:
    return simulate(preset("office"), 0)


@pytest.fixture(scope="session")
def make() -> Make:
    """``make(seed, faults={...})``: a minute of the office, with changes to its settings."""

    def call(seed: int = 0, name: str = "office", **changes: object) -> Log:
        drive = {"duration": 60.0} | changes.pop("drive", {})
        return simulate(preset(name, {"drive": drive, **changes}), seed)

    return call
