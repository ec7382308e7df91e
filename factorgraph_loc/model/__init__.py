"""Values that all packages share: logs, rigs, worlds, trajectories, beliefs, diagnostics."""
