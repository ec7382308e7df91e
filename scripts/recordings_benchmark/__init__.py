"""Recordings of other people: which, how they become logs, and what the estimators make of them."""
