"""The sections of scripts/benchmarks/bench_camera."""
