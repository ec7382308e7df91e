"""Bounded text, numbers, tables and models of settings in files; what is wrong with them is one line."""
