"""File names in a result folder."""

FILES = (
    "final.tum",
    "causal.tum",
    "estimates.parquet",
    "learnt.json",
    "events.csv",
    "config.toml",
    "metrics.json",
)  # the last one is written last
