"""The sections of scripts/bench_formats."""
