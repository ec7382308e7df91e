"""Benchmark of localization by landmarks on recorded logs: sections of docs/results.md and docs/consistency.md, and --quick."""

from landmarks_benchmark import peers, speed, starts

SECTIONS = {"speed": speed.section, "peers": peers.section, "starts": starts.section}
