"""What the tests of the odometry share."""

from unknown_robot import simulate  # noqa: F401 - a fixture
