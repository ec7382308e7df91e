"""Localization by landmarks on recorded logs: sections of docs/results.md and docs/consistency.md, and the quick benchmark."""

from landmarks_benchmark import peers, speed, starts

SECTIONS = {"speed": speed.section, "peers": peers.section, "starts": starts.section}
