"""The calibrator of RFID readers, and its plot of the detection models for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, png
from factorgraph_loc.drawing.pages import Part, Picture
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator, SensorKnowledge
from factorgraph_loc.sensors.rfid.calibration.learn import RfidFit, learn_rfid, relearn_rfid
from factorgraph_loc.sensors.rfid.settings import PriorSettings, default_models
from factorgraph_loc.sensors.smoothed import Traced
from factors.rfid.model import probability
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

VIEW = 6.0  # m; half the side of the plot around the antenna
STEP = 0.1  # m; grid spacing of the plot


class RfidCalibrator(Calibrator):
    """Estimates survey transform, antenna mounting and detection models from reads and misses along trajectories."""

    section, channel = "rfid", "rfid"

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Return the transform of surveyed tags to the world, the mounting of antennas, and the models of the read
        probability. They are estimated from the logs ``traced``. ``rig``: the rig with initial values. With smoothed
        trajectories, the transform is not estimated. Other arguments: see :meth:`Calibrator.learn`. Raises InputError
        without antennas or for too short logs."""
        logs = [replace(trace.log, rig=rig) for trace in traced]
        if self.channel not in logs[0].streams or self.channel not in rig.sensors:
            return SensorKnowledge()
        if rig.rfid is None:
            raise InputError(
                f"{logs[0].name}: its rig has no RFID antennas, expected the mounting of antennas in [rfid.antennas]"
            )
        if rig.rfid.tags:
            raise InputError(
                f"{logs[0].name}: antennas in the map are not calibrated: remove rfid from sensors of the rig, to calibrate only "
                "the rest"
            )
        if grids is None:
            raise ValueError("grids is None, but logs with reads of tags need a path for detection grids")
        if traced[0].constants is not None:
            return relearn_rfid(traced, rig, first, grids)
        known: RfidFit | None = None if like is None else like.details
        return learn_rfid(logs, rig, grids, None if known is None else known.kind)

    def with_priors(self, rig: Rig, first: Rig) -> Rig:
        """Return ``rig`` with the priors of the detection models in ``first``. Use this if smoothing and calibration
        alternate, see :meth:`Calibrator.with_priors`."""
        if rig.rfid is None or first.rfid is None:
            return rig
        priors: dict[str, PriorSettings] = {name: model.prior for name, model in first.rfid.models.items()}
        models = {name: model.model_copy(update={"prior": priors[name]}) for name, model in rig.rfid.models.items()}
        return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})

    def is_complete(self, rig: Rig) -> bool:
        """Return False if ``rig`` uses the reader, but lacks its section or has only the default detection model."""
        return super().is_complete(rig) and (rig.rfid is None or rig.rfid.models != default_models())

    def pictures(self, knowledge: SensorKnowledge) -> Sequence[Part]:
        """Return a title and a plot of the read probability around the antennas, or () without detection models.
        ``knowledge``: the result of :meth:`learn`."""
        if knowledge.details is None:
            return ()
        text = "Probability of a read around the antenna (triangle): observed on the left, the model on the right."
        return [text, field_figure(knowledge.details)]


CALIBRATOR = RfidCalibrator()


def field_figure(fit: RfidFit) -> Picture:
    """Return a plot of the read probability around the antenna, with one row of panels for each detection model of
    ``fit``. A row shows the observed probability on the left and the modelled one on the right. If a model depends on
    the tag's facing, a row has panels for tags that face towards, across and away."""
    facings = (1.0, 0.0, -1.0) if any(model.uses_facing for model in fit.models) else (0.0,)
    figure, axes = grid(len(fit.models), 1 + len(facings), 5.0 * len(fit.models))
    axis = np.arange(-VIEW, VIEW + 1e-9, STEP)
    edges = np.append(axis - 0.5 * STEP, axis[-1] + 0.5 * STEP)
    grid_points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    for row, model in enumerate(fit.models):
        pairs = fit.pairs.part(np.asarray(fit.which)[fit.pairs.antenna] == row)
        owners = ", ".join(a for a, w in zip(fit.antennas, fit.which, strict=True) if w == row)
        z = float(np.median(pairs.points[:, 2])) if len(pairs.points) else 0.0
        x, y = pairs.points[:, :2].T
        count, hits = (np.histogram2d(x, y, [edges, edges], weights=w)[0] for w in (pairs.count, pairs.hits))
        image = _draw(axes[row, 0], axis, np.where(count > 0.0, hits / np.maximum(count, 1e-9), np.nan))
        axes[row, 0].set_title(f"share of rounds with a read ({owners})")
        points = np.column_stack((grid_points, np.full(len(grid_points), z)))
        for panel, facing in zip(axes[row, 1:], facings, strict=True):
            _draw(panel, axis, probability(model, points, facing).reshape(len(axis), -1))
            panel.set_title(f"model, tag {z:+.1f} m high" + (f", facing {facing:+.0f}" if len(facings) > 1 else ""))
        figure.colorbar(image, ax=axes[row, -1], label="probability of a read in a round")
    return png(figure)


def _draw(panel: Axes, axis: Array, values: Array) -> QuadMesh:
    """Draw probabilities on a square grid, and the antenna at the origin. ``axis`` (N,): grid positions [m] in x and in
    y. ``values`` (N, N): the probabilities. Returns the drawn image."""
    image = panel.pcolormesh(axis, axis, values.T, vmin=0.0, vmax=1.0, cmap="viridis", shading="nearest")
    panel.plot(0.0, 0.0, ">", color=COLOURS[1], markersize=9)
    panel.set_aspect("equal")
    panel.set(xlabel="x, along the boresight [m]", ylabel="y, to the left [m]")
    return image
