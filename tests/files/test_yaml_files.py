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
        ("a: &x 1\nb: *x\n", "a.yaml:2: .*: [*]x is an alias, expected the value itself"),
        ("a: 1\nb: " + "[" * 1000 + "]" * 1000, "a.yaml: is not YAML that can be read: it is nested too deeply"),
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
