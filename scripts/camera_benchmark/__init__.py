"""The sections of scripts/bench_camera."""
