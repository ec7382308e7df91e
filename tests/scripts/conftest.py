"""What the tests of the scripts share."""

from straight_log import log  # noqa: F401 - a fixture
