"""The sections of scripts/benchmarks/bench_active."""
