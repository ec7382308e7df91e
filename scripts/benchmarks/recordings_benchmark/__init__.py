"""Public recordings: list, conversion to logs, and results of the estimators."""
