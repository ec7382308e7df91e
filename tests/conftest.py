"""What several tests share."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# the same examples on each run; no deadline, as the first call of a compiled function takes seconds
settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Features that tests find are not put into the user's cache, nor taken from it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FGLOC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of recorded data; the test is skipped where it is absent."""
    folder = os.environ.get("FGLOC_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("FGLOC_DATA names no folder of recorded data")
    return Path(folder)
