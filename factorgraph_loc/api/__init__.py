"""The commands of ``fgloc`` as functions that return their results instead of printing them.

They are available as ``factorgraph_loc.run`` and so on, and are imported when they are first used. A log may be given
by its name. The arguments ``rig`` and ``world``, values or files, replace the rig and the map of a log. Invalid input
raises :class:`~factorgraph_loc.errors.InputError`. A run without a usable result raises
:class:`~factorgraph_loc.errors.RunFailedError`.
"""

__all__ = ["learning", "logs", "lookups", "results", "running"]
