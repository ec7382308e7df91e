"""Active localization: where to drive to know where the robot is."""
