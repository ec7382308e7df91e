"""What is learnt from logs: here the constants and the noise of a robot's sensors, from runs with a reference."""
