"""Sections of scripts/benchmarks/bench_growth."""
