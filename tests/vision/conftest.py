"""A picture that several tests look at."""

from picture import picture  # noqa: F401 - a fixture
