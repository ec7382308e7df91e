"""A short real log on disk, and a way to call the command line in this process."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from factorgraph_loc.cli.main import app
from factorgraph_loc.readers import load, write_native

Fgloc = Callable[..., Result]
SECONDS = 60.0


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first minute of Plaza2 as a native folder; tests that change it take a copy."""
    (log,) = load("plaza2")
    start = log.span()[0]

    def cut(rows: object) -> object:
        """The columns of a stream or a trajectory, up to the end of the minute."""
        n = int((rows.t < start + SECONDS).sum())
        columns = {f.name: getattr(rows, f.name) for f in dataclasses.fields(rows)}
        return dataclasses.replace(rows, **{k: v[:n] for k, v in columns.items() if hasattr(v, "__len__")})

    folder = tmp_path_factory.mktemp("logs") / "short"
    streams = {name: cut(stream) for name, stream in log.streams.items()}
    write_native(dataclasses.replace(log, name="short", streams=streams, reference=cut(log.reference)), folder)
    return folder


@pytest.fixture
def fgloc() -> Fgloc:
    """``fgloc("info", path)``: runs the command and returns exit code, stdout and stderr."""

    def call(*args: object) -> Result:
        return CliRunner().invoke(app, [str(arg) for arg in args])

    return call
