"""What the tests of RFID share."""

from read_tags import read_tags  # noqa: F401 - a fixture
