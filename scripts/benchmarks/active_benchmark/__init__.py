"""Benchmark of active localization, in which a robot chooses its paths: the sections of docs/active.md."""

from active_benchmark.sections import estimators, policies

SECTIONS = {"policies": policies, "estimators": estimators}
