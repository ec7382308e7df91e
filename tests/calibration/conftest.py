"""Fixtures of the tests of calibration."""

from read_tags import read_tags  # noqa: F401 - a fixture
from unknown_robot import headless, simulate  # noqa: F401 - fixtures
