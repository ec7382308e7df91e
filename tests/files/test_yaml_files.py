"""YAML of maps and calibrations: what other programs write is read, and what cannot be is told in one line."""

import time

import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.yaml import DEEPEST, read_yaml


@pytest.fixture
def read(tmp_path):
    def of(text):
        (tmp_path / "a.yaml").write_text(text)
        return read_yaml(tmp_path / "a.yaml")

    return of


def test_a_file_of_opencv(read):
    text = """%YAML:1.0
---
calibration_time: "Mon 03 Nov 2025"
image_width: 640
flags: 0
camera_matrix: !!opencv-matrix
   rows: 1
   cols: 3
   dt: d
   data: [ 5.2e+02, 0., 3.195e+02,
       -.5 ]
error: 5e-2
worst: .Inf
"""
    assert read(text) == {
        "calibration_time": "Mon 03 Nov 2025",
        "image_width": 640,
        "flags": 0,
        "camera_matrix": {"rows": 1, "cols": 3, "dt": "d", "data": [520.0, 0.0, 319.5, -0.5]},
        "error": 0.05,
        "worst": float("inf"),
    }


@pytest.mark.parametrize("head", ["", "---\n", "%YAML 1.1\n---\n", "%YAML:1.0\n", "%YAML:1.0\n---\n", "# made by us\n"])
def test_beginnings(read, head):
    assert read(f"{head}a: 1\n...\n") == {"a": 1}


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ('"floor #2.pgm"', "floor #2.pgm"),
        ("floor#2.pgm # the second", "floor#2.pgm"),
        ("'it''s'", "it's"),
        ("on", "on"),
        ("no", "no"),
        ("yes", "yes"),
        ("true", "true"),
        ("2025-11-03", "2025-11-03"),
        ("12:30:00", "12:30:00"),
        ("0x1f", "0x1f"),
        ('"5"', "5"),
        ("5", 5),
        ("-010", -10),
        ("5e-2", 0.05),
        ("+1.", 1.0),
        ("!!float 3", 3),
        ("9" * 30, 1e30),
        ("[1, 2.5, on]", [1, 2.5, "on"]),
        ("\n  - 1\n  - [2, 3]", [1, [2, 3]]),
        ("{b: {c: 1}}", {"b": {"c": 1}}),
        ("&here 7", 7),
    ],
)
def test_values(read, written, value):
    found = read(f"a: {written}\nz: 0\n")["a"]
    assert found == value
    assert type(found) is type(value)


def test_keys_without_a_value_are_left_out(read):
    assert read("a:\nb: ~\nc: null\nd: ''\n") == {"d": ""}
    assert read("") == read("# nothing\n") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: [1, 2\nc: 3\n", "a.yaml:2: is not YAML that can be read: while parsing a flow sequence"),
        ("a: 1\nb 2\nc: 3\n", "a.yaml:2: is not YAML that can be read: while scanning a simple key"),
        ("a: &x 1\nb: *x\n", "a.yaml:2: [*]x is an alias, expected the value itself"),
        ("a: &x {c: 1}\nb:\n  <<: *x\n", "a.yaml:3: [*]x is an alias"),
        ("a: 1\nb: " + "[" * 1000 + "]" * 1000, f"a.yaml:2: blocks are nested more than {DEEPEST} deep"),
        ("a: 1\n---\nb: 2\n", "a.yaml:1: .* expected a single document"),
        ("- 1\n- 2\n", "a.yaml:1: .* expected key: value"),
        ("a: 1\n? [b]\n: 2\n", "a.yaml:2: a key is not text"),
        ("a: 1\n\tb: 2\n", "a.yaml:2: is not YAML"),
        ("a: \x07\n", "a.yaml: is not YAML"),
    ],
)
def test_what_is_wrong_is_one_line(read, text, said):
    with pytest.raises(InputError, match=said) as caught:
        read(text)
    assert "\n" not in str(caught.value)


def test_a_file_that_would_grow_is_refused_at_once(read):
    grown = "".join(f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(12))
    began = time.perf_counter()
    with pytest.raises(InputError, match="is an alias"):
        read(f"a: &a [1, 1]\n{grown}")
    assert time.perf_counter() - began < 1.0


def test_lists_within_lists_take_no_longer_than_others(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\nb: " + "[" * 50_000 + "\n")
    started = time.monotonic()
    with pytest.raises(InputError, match=r"a.yaml:2: blocks are nested more than 20 deep"):
        read_yaml(path)
    assert time.monotonic() - started < 2.0
