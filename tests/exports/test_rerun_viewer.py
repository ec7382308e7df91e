"""The viewer's server, without its window, which a machine without a display cannot open."""

import os
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.exports import rerun_viewer

pytest.importorskip("rerun")
from factorgraph_loc.exports import rerun_scene

LISTEN = "0A"  # state of a socket


@pytest.fixture
def port(monkeypatch):
    """A free port for the viewer."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    monkeypatch.setattr(rerun_viewer, "PORT", free)
    return free


@pytest.fixture
def started(monkeypatch, port):
    """The processes that are started, with servers at the port."""
    assert port == rerun_viewer.PORT
    processes = []
    start = rerun_viewer._start
    monkeypatch.setattr(rerun_viewer, "COMMAND", (*rerun_viewer.COMMAND, "--serve-grpc"))
    monkeypatch.setattr(rerun_viewer, "_start", lambda *args: processes.append(start(*args)) or processes[-1])
    yield processes
    for process in processes:
        with suppress(ProcessLookupError):  # a test has killed it
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def listening(port):
    """The addresses of this machine at which a program listens on the port."""
    tables = [Path(f"/proc/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    found = set()
    for fields in (row.split() for table in tables for row in table):
        address, at = fields[1].split(":")
        if int(at, 16) == port and fields[3] == LISTEN:
            found.add(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if len(address) == 8 else address)
    return found


@pytest.mark.usefixtures("started")
@pytest.mark.parametrize("bind", ["127.0.0.1", "0.0.0.0"])
def test_it_listens_at_the_given_address(port, bind):
    with rerun_viewer.open_viewer(bind) as url:
        assert url == f"rerun+http://127.0.0.1:{port}/proxy"
        assert listening(port) == {bind}


def test_a_log_is_shown_on_this_machine_alone_and_an_open_viewer_is_used(started, port, log, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    rerun_scene.show(log, [])
    assert listening(port) == {"127.0.0.1"}
    rerun_scene.show(log, [])
    assert len(started) == 1


@pytest.mark.usefixtures("port")
def test_a_viewer_that_does_not_start(monkeypatch):
    program = "print('Error: no window'); raise SystemExit(1)"
    monkeypatch.setattr(rerun_viewer, "COMMAND", (sys.executable, "-c", program))
    viewer = rerun_viewer.open_viewer("127.0.0.1")
    with (
        pytest.raises(InputError, match=r"^the viewer did not start: no window: use --rrd FILE to write a file"),
        viewer,
    ):
        pass


def test_another_program_at_the_port(port):
    expected = f"^127.0.0.1:{port}: no viewer answers there: gRPC connection severed$"
    viewer = rerun_viewer.open_viewer("127.0.0.1")
    with socket.create_server(("127.0.0.1", port)), pytest.raises(InputError, match=expected), viewer:
        raise RuntimeError("gRPC connection severed")


def test_a_viewer_that_is_closed_too_early(started):
    viewer = rerun_viewer.open_viewer("127.0.0.1")
    with pytest.raises(InputError, match=r"^the viewer was closed$"), viewer:  # noqa: PT012
        os.killpg(started[0].pid, signal.SIGKILL)
        started[0].wait()


def test_an_invalid_address():
    viewer = rerun_viewer.open_viewer("localhost")
    with pytest.raises(InputError, match=r"^bind is 'localhost', expected an IP address such as 127\.0\.0\.1$"), viewer:
        pass
