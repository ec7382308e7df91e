"""Benchmark of ranges to beacons at unknown positions: a section of docs/ranges.md."""

from ranges_benchmark import pyfg

SECTIONS = {"7. Unknown beacons": pyfg.section}
