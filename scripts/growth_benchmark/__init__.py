"""Sections of scripts/bench_growth."""
