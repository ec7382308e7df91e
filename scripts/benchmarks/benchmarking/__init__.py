"""Common parts of the benchmarks: their command line, tables, and parallel jobs."""
