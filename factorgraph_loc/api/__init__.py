"""The commands of ``fgloc`` as functions that return their results instead of printing them.

They are available as ``factorgraph_loc.run`` and so on, each imported when it is first used. A log may be given by its name;
``rig`` and ``world`` replace those of the log, and are values or files. Invalid input raises
:class:`~factorgraph_loc.errors.InputError`, and a run without a usable result :class:`~factorgraph_loc.errors.RunFailedError`.
Functions with ``jobs``, and :func:`~factorgraph_loc.api.logs.simulate` with images, spawn processes, so a script that calls them
needs ``if __name__ == "__main__"``.
"""

__all__ = ["experimenting", "learning", "logs", "lookups", "results", "running"]
