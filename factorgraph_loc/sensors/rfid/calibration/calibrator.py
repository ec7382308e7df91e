"""The calibrator of RFID, from reads and misses along trajectories."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from factorgraph_loc.drawing.pages import Part
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator, SensorKnowledge
from factorgraph_loc.sensors.rfid.calibration.learn import RfidFit, learn_rfid, relearn_rfid
from factorgraph_loc.sensors.rfid.calibration.report import field_figure
from factorgraph_loc.sensors.rfid.settings import PriorSettings, default_models
from factorgraph_loc.sensors.smoothed import Traced


class RfidCalibrator(Calibrator):
    """The calibrator of RFID."""

    section, channel = "rfid", "rfid"

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Survey, mounting and models from logs with reads; with smoothed trajectories no survey."""
        logs = [replace(trace.log, rig=rig) for trace in traced]
        if self.channel not in logs[0].streams or self.channel not in rig.sensors:
            return SensorKnowledge()
        if rig.rfid is None:
            raise InputError(
                f"{logs[0].name}: its rig has no RFID antennas, expected their mounting in [rfid.antennas]"
            )
        if grids is None:
            raise ValueError("logs with reads of tags need a place for grids")
        if traced[0].constants is not None:
            return relearn_rfid(traced, rig, first, grids)
        known: RfidFit | None = None if like is None else like.details
        return learn_rfid(logs, rig, grids, None if known is None else known.kind)

    def with_priors(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the first priors of its detection models."""
        if rig.rfid is None or first.rfid is None:
            return rig
        priors: dict[str, PriorSettings] = {name: model.prior for name, model in first.rfid.models.items()}
        models = {name: model.model_copy(update={"prior": priors[name]}) for name, model in rig.rfid.models.items()}
        return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})

    def is_complete(self, rig: Rig) -> bool:
        """Whether a detection model was learnt or given, because the default model is uninformative."""
        return super().is_complete(rig) and (rig.rfid is None or rig.rfid.models != default_models())

    def pictures(self, knowledge: SensorKnowledge) -> Sequence[Part]:
        """The field around the antenna."""
        if knowledge.details is None:
            return ()
        text = "Probability of a read around the antenna (triangle): observed on the left, the model on the right."
        return [text, field_figure(knowledge.details)]


CALIBRATOR = RfidCalibrator()
