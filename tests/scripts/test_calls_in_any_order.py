"""Calls of Localizer in any order, with any values: only our errors, finite estimates, and questions that change nothing."""

from fuzzing.calls import Draw, play, sequence
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


class Drawn(Draw):
    """Choices of hypothesis, which looks for a shorter sequence where one fails."""

    def __init__(self, draw):
        self._draw = draw

    def integer(self, low, high):
        return self._draw(st.integers(low, high))

    def number(self, low, high):
        return self._draw(st.floats(low, high, allow_nan=False))


@st.composite
def sequences(draw):
    return sequence(Drawn(draw), longest=15)


@given(sequences())
@settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
)
def test_calls_in_any_order(played):
    play(played)
