"""Common parts of the benchmarks: tables, parallel jobs, and statistics of many runs."""
