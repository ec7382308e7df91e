"""A full disk ends what writes results with one line that names them. It is a limit of the size of a file here."""

import resource
from contextlib import contextmanager

import pytest

import factorgraph_loc as fgloc


@contextmanager
def full(size):
    """Refuse to write more than ``size`` bytes to a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="module")
def office():
    """A drive whose tables are larger than the rig and the map."""
    return fgloc.simulate("office", 3, changes={"drive": {"duration": 60.0}, "world": {"tags": 1}})


@pytest.mark.parametrize("format", ["csv", "parquet"])
@pytest.mark.parametrize("size", [0, 8000])
def test_a_log_is_not_written(office, tmp_path, format, size):
    with full(size), pytest.raises(fgloc.InputError) as caught:
        fgloc.convert(office, tmp_path / "log", format=format)
    assert str(caught.value) == f"{tmp_path / 'log'}: cannot be written: File too large"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [0, 30_000])
def test_a_run_is_not_written(office, tmp_path, size):
    fgloc.run(office, "dead_reckoning")
    with full(size), pytest.raises(fgloc.InputError) as caught:
        fgloc.run(office, "dead_reckoning", out=tmp_path / "run")
    assert str(caught.value) == f"{tmp_path / 'run'}: cannot be written: File too large"
    assert list(tmp_path.iterdir()) == []
