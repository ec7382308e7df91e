"""The tables and the picture of docs/smoother-or-filter.md, from the runs of the experiments in scripts/experiments/smoothing."""
