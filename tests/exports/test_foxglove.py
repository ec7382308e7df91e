"""MCAP files are read back with the library that Foxglove's own tools use."""

import base64
import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.exports.foxglove import write_mcap
from factorgraph_loc.exports.runs import find_runs, read_runs

from .conftest import T0_NS

reader = pytest.importorskip("mcap.reader")


class Messages:
    """Messages by topic, as (seconds of the log, content); the schema of each topic."""

    def __init__(self, path, t0_ns=T0_NS):
        self.by_topic, self.schemas, self.ns = {}, {}, []
        with path.open("rb") as file:
            for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages(
                log_time_order=False
            ):
                content = json.loads(message.data)
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                assert set(content) <= set(json.loads(schema.data)["properties"])
                self.schemas[channel.topic] = schema.name
                self.ns.append(message.log_time)
                self.by_topic.setdefault(channel.topic, []).append(((message.log_time - t0_ns) / 1e9, content))

    def __call__(self, topic):
        return self.by_topic.get(topic, [])


@pytest.fixture(scope="module")
def runs(log, results):
    return read_runs(find_runs(results), log)


@pytest.fixture(scope="module")
def messages(log, runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("foxglove") / "arc.mcap"
    write_mcap(log, runs, path)
    return Messages(path)


def test_topics_and_their_schemas(messages):
    of_run = {
        "pose": "foxglove.PoseInFrame",
        "transform": "foxglove.FrameTransform",
        "path": "foxglove.PosesInFrame",
        "ellipse": "foxglove.SceneUpdate",
        "estimate": "fgloc.Estimate",
        "landmarks": "foxglove.SceneUpdate",
        "events": "foxglove.Log",
    }
    assert messages.schemas == {
        "/map": "foxglove.SceneUpdate",
        "/tags": "foxglove.SceneUpdate",
        "/landmarks": "foxglove.SceneUpdate",
        "/camera/image": "foxglove.CompressedImage",
        "/camera/landmarks": "foxglove.ImageAnnotations",
        "/reference/pose": "foxglove.PoseInFrame",
        "/reference/path": "foxglove.PosesInFrame",
        **{f"/{run}/{topic}": schema for run in ("ekf", "dead_reckoning") for topic, schema in of_run.items()},
    }
    assert messages.ns == sorted(messages.ns)


def test_poses_and_covariances_are_those_of_the_run(messages, runs):
    for run in runs:
        poses, estimates = messages(f"/{run.name}/pose"), messages(f"/{run.name}/estimate")
        assert np.allclose([t for t, _ in poses], run.causal.t, atol=1e-6)
        assert all(
            m["timestamp"] == {"sec": round(T0_NS + t * 1e9) // 10**9, "nsec": pytest.approx(t % 1 * 1e9, abs=1e3)}
            for t, m in poses
        )
        turns = [m["pose"]["orientation"] for _, m in poses]
        assert np.allclose([2.0 * np.arctan2(q["z"], q["w"]) for q in turns], run.causal.poses[:, 2])
        assert np.allclose([(m["x"], m["y"], m["heading"]) for _, m in estimates], run.causal.poses)
        assert np.allclose([np.reshape(m["covariance"], (3, 3)) for _, m in estimates], run.causal.covariances)
        assert np.allclose([m["error_position"] for _, m in estimates], run.series["error_position"][1])
        ((_, path),) = messages(f"/{run.name}/path")
        assert np.allclose([(p["position"]["x"], p["position"]["y"]) for p in path["poses"]], run.final.poses[:, :2])


def test_what_is_drawn(messages):
    ((_, drawn),) = messages("/map")
    assert [e["id"] for e in drawn["entities"]] == ["walls", "tags", "landmarks"]
    assert [t["text"] for t in drawn["entities"][1]["texts"]] == ["A", "B"]
    lit = [(round(t, 6), [text["text"] for text in m["entities"][0]["texts"]]) for t, m in messages("/tags")]
    assert lit == [(1.0, ["A"]), (1.5, []), (1.8, ["A"]), (2.0, ["A", "B"]), (2.3, ["B"]), (2.5, [])]
    _, ellipse = messages("/ekf/ellipse")[-1]
    (line,) = ellipse["entities"][0]["lines"]
    assert line["points"][0] == line["points"][-1]


def test_images_and_what_was_seen_in_them(messages):
    images = messages("/camera/image")
    for i, (_, m) in enumerate(images):
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(m["data"]), dtype=np.uint8), cv2.IMREAD_COLOR)
        assert abs(picture.astype(int) - 80 * i).max() <= 2
    seen = [[(text["text"], text["position"]) for text in m["texts"]] for _, m in messages("/camera/landmarks")]
    assert seen == [[("p", {"x": 1.0, "y": 4.0}), ("q", {"x": 2.0, "y": 5.0})], [("p", {"x": 3.0, "y": 6.0})]]


def test_times_before_the_epoch_and_headings_that_mean_nothing(log, tmp_path):
    reference = log.reference
    unknown = replace(reference, t=reference.t - 3.0, poses=reference.poses * (1.0, 1.0, np.nan), has_heading=False)
    write_mcap(replace(log, reference=unknown, t0_ns=0), [], tmp_path / "log.mcap")
    found = Messages(tmp_path / "log.mcap", 0)
    assert min(found.ns) >= 0
    assert found("/reference/pose")[0][1]["pose"]["orientation"]["w"] == 1.0


def test_without_the_library_or_the_folder(log, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"log.mcap: cannot be written: No such file"):
        write_mcap(log, [], tmp_path / "missing" / "log.mcap")
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(InputError, match=r"pip install 'factorgraph-loc\[foxglove\]'"):
        write_mcap(log, [], tmp_path / "log.mcap")


def test_what_the_format_cannot_hold_is_told_of_and_nothing_is_left(log, runs, tmp_path):
    poses = runs[0].causal.poses.copy()
    poses[3, 0] = np.nan
    broken = replace(runs[0], causal=replace(runs[0].causal, poses=poses))
    with pytest.raises(InputError, match=r"at \d+\.\d+ s has a value that is not finite"):
        write_mcap(log, [broken], tmp_path / "log.mcap")
    assert not list(tmp_path.iterdir())
