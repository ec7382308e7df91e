"""Logs with other streams, or other settings of the rig."""

from dataclasses import replace

import numpy as np

from factorgraph_loc import Log
from factorgraph_loc.model.measurement import columns_of


def with_stream(log: Log, name: str, **columns) -> Log:
    return replace(log, streams={**log.streams, name: replace(log.streams[name], **columns)})


def rows(log: Log, name: str, kept) -> Log:
    """The log with these rows (M,) of a stream."""
    columns = columns_of(log.streams[name])
    return with_stream(
        log, name, **{k: v[kept] if isinstance(v, np.ndarray) else [v[i] for i in kept] for k, v in columns.items()}
    )


def with_rig(log: Log, part: str, **settings) -> Log:
    changed = getattr(log.rig, part).model_copy(update=settings)
    return replace(log, rig=log.rig.model_copy(update={part: changed}))
