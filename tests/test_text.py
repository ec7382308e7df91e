import pickle
import sys

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.errors import RunFailedError, bad_field
from factorgraph_loc.text import MESSAGE, VALUE, error_text, listed, one_line, plain, quoted

ANY = st.text(st.characters(), max_size=400)  # lone surrogates and control characters too
NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | ANY | st.binary() | st.dates(),
    lambda inner: st.lists(inner) | st.dictionaries(ANY, inner) | st.tuples(inner, inner),
    max_leaves=30,
)


def test_escapes_are_those_of_python() -> None:
    assert plain("\x1b[1m\u202e\udce9\n") == "\\x1b[1m\\u202e\\udce9\\n"
    assert quoted("a\nb") == "'a\\nb'"


def test_values_are_written_as_python_writes_them() -> None:
    for value in (None, True, 3, -2.5, float("nan"), "a", b"a", [1, "b"], (1, 2), {"a": [1]}):
        assert quoted(value) == repr(value)
    assert quoted(np.float64(0.5)) == "0.5"
    assert quoted(np.array([1, 2])) == "array([1, 2])"


def test_a_number_of_thousands_of_digits_is_described() -> None:
    assert sys.get_int_max_str_digits() < 10**4
    for value in (10**10000, -(10**10000), [10**10000], {"a": 10**10000}):
        assert "about 10001 digits" in quoted(value)
    assert quoted(10**18) == "1000000000000000000"


def test_of_long_and_deep_values_little_is_looked_at() -> None:
    deep: list[object] = []
    for _ in range(10**5):
        deep = [deep]
    assert quoted(deep) == "[[[[...]]]]"
    assert quoted(list(range(10**6))) == "[0, 1, 2, 3, 4, ...]"


def test_of_many_names_the_first_are_listed() -> None:
    assert listed(["b", "a\n"]) == "b, a\\n"
    assert listed(range(1000)) == "0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 990 more"


def test_what_an_exception_says_fits_on_a_line() -> None:
    assert error_text(RuntimeError("one\n\n  two")) == "one two"
    assert error_text(RuntimeError()) == "RuntimeError"
    assert error_text(FileNotFoundError(2, "No such file or directory", "x")) == "No such file or directory"
    assert error_text(OSError("3 requested and 0 written")) == "3 requested and 0 written"


@settings(max_examples=200)
@given(value=NESTED)
def test_any_value_is_shown_in_bounds(value: object) -> None:
    shown = quoted(value)
    assert shown.isprintable()
    assert len(shown) <= VALUE


@settings(max_examples=200)
@given(text=ANY, value=NESTED, row=st.none() | st.integers(1, 10**9))
def test_any_error_is_one_line_of_bounded_length(text: str, value: object, row: int | None) -> None:
    for error in (RunFailedError(text * 3), bad_field(text * 3, text * 3, value, text * 3, row=row)):
        message = str(error)
        assert message.isprintable()
        assert len(message) <= MESSAGE
        assert one_line(message) == message
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again)) == (type(error), message)
