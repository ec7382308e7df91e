"""The commands of ``fgloc`` as functions that return their results instead of printing them.

They are available as ``factorgraph_loc.run`` and so on, each imported when it is first used. A log may be given by its name;
``rig`` and ``world`` replace those of the log, and are values or files. Invalid input raises
:class:`~factorgraph_loc.errors.InputError`, and a run without a usable result :class:`~factorgraph_loc.errors.RunFailedError`.
"""

__all__ = ["learning", "logs", "lookups", "results", "running"]
