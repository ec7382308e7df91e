"""What is said where something is refused."""

import pytest

from factorgraph_loc import InputError


def refusal(call, *words):
    """The short line with which ``call()`` refuses; it has all ``words``."""
    with pytest.raises(InputError) as caught:
        call()
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 400
    for word in words:
        assert word in line
    return line
