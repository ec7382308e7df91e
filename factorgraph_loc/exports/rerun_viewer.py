"""Starts the process of the Rerun viewer.

The viewer requires no password, and ``rerun.spawn`` makes it listen on all network interfaces. This module starts it
instead, so that it listens on one address.
"""

import ipaddress
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

PORT = 9876
COMMAND = (sys.executable, "-P", "-m", "rerun_cli")  # -P: Python imports no modules from the working folder
LOOPBACK = "127.0.0.1"
PATIENCE = 30.0  # s: maximum time for the viewer to start


@contextmanager
def open_viewer(bind: str) -> Iterator[str]:
    """Yield the URL of a Rerun viewer, for :meth:`rerun.RecordingStream.connect_grpc`. Starts a viewer unless one is
    open.

    A new viewer listens on the IP address ``bind`` and stays open after the end of this process. Raises InputError if
    ``bind`` is no IP address, or if the viewer does not start or is closed during the block.
    """
    host = _reachable(bind)
    url = f"rerun+http://{f'[{host}]' if ':' in host else host}:{PORT}/proxy"
    with tempfile.TemporaryFile() as printed:
        process = None if _is_listening(host) else _start(bind, printed)
        latest = time.monotonic() + PATIENCE
        while process is not None and not _is_listening(host):
            if process.poll() is not None or time.monotonic() > latest:
                raise InputError(
                    f"the viewer did not start{_reason(printed)}: use --rrd FILE to write a file that `rerun FILE` opens"
                )
            time.sleep(0.1)
        try:
            yield url
        except RuntimeError as error:  # raised by the library rerun
            raise InputError(f"{host}:{PORT}: no viewer answers there: {error}{_reason(printed)}") from error
        if process is not None and process.poll() is not None:
            raise InputError(f"the viewer was closed{_reason(printed)}")


def _reachable(bind: str) -> str:
    """Return the address at which this machine reaches a server that listens on ``bind``.

    Raises InputError if ``bind`` is not an IP address."""
    try:
        address = ipaddress.ip_address(bind)
    except ValueError as error:
        raise InputError(f"bind is {quoted(bind)}, expected an IP address such as {LOOPBACK}") from error
    if address.is_unspecified:
        return LOOPBACK if address.version == 4 else "::1"
    return str(address)


def _is_listening(host: str) -> bool:
    try:
        socket.create_connection((host, PORT), timeout=1.0).close()
    except OSError:
        return False
    return True


def _start(bind: str, printed: BinaryIO) -> "subprocess.Popen[bytes]":
    """Start the viewer and return its process. It has its own session, so that it stays open when the terminal is
    closed.

    ``bind``: the IP address at which the viewer listens. ``printed``: a file for the output of the viewer."""
    command = [*COMMAND, "--bind", bind, "--port", str(PORT), "--expect-data-soon"]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=printed, stderr=printed, start_new_session=True)


def _reason(printed: BinaryIO) -> str:
    """Return ": " followed by the error in the output ``printed`` of the viewer, or "" if it has no error."""
    printed.seek(0)
    lines = printed.read().decode(errors="replace").splitlines()
    return next((f": {line.removeprefix('Error: ')}" for line in lines if line.startswith(("Error", "thread "))), "")
