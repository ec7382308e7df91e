"""The sections of scripts/bench_experiments."""
