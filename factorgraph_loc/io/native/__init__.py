"""The native format: run folders, rigs and worlds."""
