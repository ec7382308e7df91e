"""Runs that never were, and Chromium without a window, driven through a pipe by the DevTools protocol, for tests of pages."""

import base64
import io
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

from factorgraph_loc.evaluation.report import RunFiles, Scene
from factorgraph_loc.model.scoring import MAX_GAP


class Chromium:
    """One tab. ``problems``: what the console told of errors."""

    def __init__(self, command, profile):
        ours, to_child = os.pipe(), os.pipe()  # what it writes, what it reads
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe"]
        line = f'exec "$0" "$@" 3<&{to_child[0]} 4>&{ours[1]}'
        self._process = subprocess.Popen(
            ["bash", "-c", line, command, *flags, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(to_child[0], ours[1]),
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        os.close(to_child[0])
        os.close(ours[1])
        self._from, self._to = os.fdopen(ours[0], "rb"), os.fdopen(to_child[1], "wb")
        self._count, self._session = 0, None
        self.problems, self._events = [], []
        (target,) = [t for t in self.send("Target.getTargets")["targetInfos"] if t["type"] == "page"][:1]
        found = self.send("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method, **params):
        """The result of a command."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        self._to.write(json.dumps(message).encode() + b"\0")
        self._to.flush()
        while True:
            answer = self._read()
            if answer.get("id") == self._count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def open(self, path, *, width=1280, height=900, dark=False, phone=False):
        """Open a page in a window of this size, and wait until its script is done."""
        self.problems, self._events = [], []
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Page.navigate", url=path.resolve().as_uri())
        while not any(event == "Page.loadEventFired" for event, _ in self._events):
            self._read()

    def requests(self):
        """The addresses that the page asked for, beside its own."""
        return [p["request"]["url"] for e, p in self._events if e == "Network.requestWillBeSent"][1:]

    def run(self, expression):
        """The value of a JavaScript expression."""
        found = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def mouse(self, kind, x, y, **more):
        """A mouse event at a place of the window."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def screenshot(self, path, *, whole=False):
        """A PNG of the window, or of the whole page."""
        size = self.send("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        more = {"clip": clip, "captureBeyondViewport": True} if whole else {}
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png", **more)["data"]))

    def close(self):
        """End it."""
        self._process.terminate()
        self._process.wait(timeout=10)
        self._from.close()
        self._to.close()

    def _read(self):
        text = bytearray()
        while (one := self._from.read(1)) != b"\0":
            assert one, "chromium has gone"
            text += one
        message = json.loads(text)
        if "method" in message:
            self._events.append((message["method"], message["params"]))
            if message["method"] == "Runtime.exceptionThrown":
                self.problems.append(message["params"]["exceptionDetails"])
            if message["method"] == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.problems.append(message["params"]["entry"]["text"])
        return message


@pytest.fixture(scope="session")
def chromium(tmp_path_factory) -> Iterator[Chromium]:
    """A browser; the test is skipped where there is none."""
    command = shutil.which("chromium") or shutil.which("chromium-browser")
    if command is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    browser = Chromium(command, tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def pictures() -> Path:
    """Where pictures of pages are kept, to be looked at."""
    folder = Path("out", "screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def estimates(rng, *, count=400, sigma=0.1, offset=(0.0, 0.0)):
    """A table as of ``estimates.parquet``: a drive in a circle, and estimates of it with errors of ``sigma`` [m] that go together
    over some time."""
    t = np.arange(count) / 10.0
    circle = np.column_stack((5.0 * np.cos(t / 8.0), 5.0 * np.sin(t / 8.0))) + offset
    parts = []
    for kind, size in (("causal", sigma), ("final", 0.6 * sigma)):
        error = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.normal(0.0, size, (count, 2)), axis=0)
        heading = rng.normal(0.0, 0.02, count)
        columns = {
            "kind": [kind] * count,
            "t_ns": np.round(t * 1e9).astype(np.int64),
            "x": circle[:, 0] + error[:, 0],
            "y": circle[:, 1] + error[:, 1],
            "heading": t / 8.0 + np.pi / 2 + heading,
            **dict.fromkeys(("cov_xy", "cov_xh", "cov_yh"), np.zeros(count)),
            **dict.fromkeys(("cov_xx", "cov_yy"), np.full(count, size**2)),
            "cov_hh": np.full(count, 0.02**2),
            "error_position": np.hypot(*error.T),
            "error_heading": np.abs(heading),
            "nees": np.sum(error**2, axis=1) / size**2 + (heading / 0.02) ** 2,
            "update_ms": np.full(count, 1.0),
            "status": ["localized"] * count,
        }
        parts.append(pl.DataFrame(columns))
    return pl.concat(parts)


@dataclass
class Made:
    """Runs that never were: ``rows`` as of :func:`load_results`, and ``runs``, what :func:`write_report` asks for their files."""

    rows: pl.DataFrame
    tables: dict[str, bytes]
    scene: Scene
    config: bytes = b'estimator = "made"\n\n[versions]\ngtsam = "4.3.0"\n'

    def runs(self, key):
        """The files of a run."""
        return RunFiles({"estimates.parquet": self.tables[key], "config.toml": self.config}.__getitem__, self.scene)


SCENE = Scene(
    walls=np.array([[-7.0, -7.0, 7.0, -7.0], [7.0, -7.0, 7.0, 7.0]]),
    layers={
        "landmarks": np.array([[0.0, 0.0], [6.0, 2.0]]),
        "tags": np.array([[-6.0, 1.0]]),
        "points": np.empty((0, 2)),
    },
    reference=(np.column_stack((5.0 * np.cos(np.linspace(0, 5, 50)), 5.0 * np.sin(np.linspace(0, 5, 50)))),),
)


def make_runs(sigmas, logs, seeds=1, *, count=400, sweep=None):
    """Runs of estimators with errors of these sizes, ``sigmas`` [m] by label, on logs of these names. ``sweep``: dotted name and
    values of a setting that multiplies the errors of all logs."""
    rng = np.random.default_rng(7)
    rows, files = [], {}
    name, values = sweep or (None, [None])
    for log in logs:
        hard = rng.uniform(0.7, 1.5)
        for value in values:
            for label, sigma in sigmas.items():
                for seed in range(seeds):
                    key = f"{len(rows):04d}"
                    table = estimates(rng, count=count, sigma=sigma * hard * (value or 1.0))
                    buffer = io.BytesIO()
                    table.write_parquet(buffer)
                    files[key] = buffer.getvalue()
                    rows.append(_row(key, log, label, seed, table) | ({name: value} if name else {}))
    return Made(pl.DataFrame(rows, infer_schema_length=None), files, SCENE)


def _row(key, log, label, seed, table):
    scores = {"scoring.max_gap": MAX_GAP}
    for kind in ("causal", "final"):
        of = table.filter(pl.col("kind") == kind)
        scores[f"{kind}.position_rmse"] = float(np.sqrt(np.mean(of["error_position"].to_numpy() ** 2)))
        scores[f"{kind}.heading_rmse"] = float(np.sqrt(np.mean(of["error_heading"].to_numpy() ** 2)))
        scores[f"{kind}.scored"] = len(of)
    head = {"key": key, "log": log, "label": label, "estimator": "ekf", "seed": seed, "status": "ok"}
    more = {"time_to_localized": 0.0, "timing.update_ms_median": 1.0 + seed, "timing.real_time_factor": 100.0}
    return head | {"kind": None, "reason": None} | scores | more


@pytest.fixture(scope="session")
def made():
    """``make_runs``."""
    return make_runs
