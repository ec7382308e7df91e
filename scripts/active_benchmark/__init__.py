"""The sections of scripts/bench_active."""
