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
COVARIANCES = {
    "cov_xx": (0, 0),
    "cov_xy": (0, 1),
    "cov_xh": (0, 2),
    "cov_yy": (1, 1),
    "cov_yh": (1, 2),
    "cov_hh": (2, 2),
}
