"""Benchmark on public recordings: the section of docs/recordings.md."""

from recordings_benchmark.recordings import section

SECTIONS = {"recordings": section}
