"""The style of plots, and helpers for HTML pages."""
