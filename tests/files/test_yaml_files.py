"""YAML of other programs is read, and invalid content is refused in one line."""

import time

import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.yaml import read_yaml


@pytest.fixture
def read(tmp_path):
    def of(text):
        (tmp_path / "a.yaml").write_text(text)
        return read_yaml(tmp_path / "a.yaml")

    return of


def test_a_file_of_map_server(read):
    text = """# made by a map saver
image: "floor #2.pgm"
resolution: 0.05
origin: [-10.0, -5., 0]
negate: 0
mode:
"""
    assert read(text) == {"image": "floor #2.pgm", "resolution": 0.05, "origin": [-10.0, -5.0, 0], "negate": 0}


def test_an_empty_file_has_no_keys(read):
    assert read("") == read("# nothing\n") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: [1, 2\nc: 3\n", "a.yaml:2: is not YAML that can be read: while parsing a flow sequence"),
        ("a: 1\nb 2\nc: 3\n", "a.yaml:2: is not YAML that can be read: while scanning a simple key"),
        ("a: &x 1\nb: *x\n", "a.yaml:2: .*: [*]x is an alias, expected the value itself"),
        ("a: &x {c: 1}\nb:\n  <<: *x\n", "a.yaml:3: .*: [*]x is an alias"),
        ("a: 1\nb: " + "[" * 1000 + "]" * 1000, "a.yaml: is not YAML that can be read: it is nested too deeply"),
        ("a: 1\n---\nb: 2\n", "a.yaml:1: .*: expected a single document"),
        ("- 1\n- 2\n", "a.yaml:1: .*: expected key: value"),
        ("a: 1\n? [b]\n: 2\n", "a.yaml:1: .*: while constructing a mapping, found unhashable key"),
        ("a: 1\n\tb: 2\n", "a.yaml:2: is not YAML"),
        ("a: \x07\n", "a.yaml: is not YAML"),
        ("a: 2025-13-45\n", "a.yaml: is not YAML that can be read: month must be in 1..12"),
        ("a: !!python/object:os.system x\n", "a.yaml:1: .*: could not determine a constructor"),
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
