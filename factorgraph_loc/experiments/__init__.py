"""Runs: one, several that are compared, and experiments of many that are kept, resumed and reported."""
