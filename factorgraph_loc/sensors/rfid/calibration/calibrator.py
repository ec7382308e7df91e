"""The calibrator of RFID, from reads and misses along trajectories."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from factorgraph_loc.drawing.pages import Part
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator, SensorKnowledge
from factorgraph_loc.sensors.rfid.calibration import report
from factorgraph_loc.sensors.rfid.calibration.learn import RfidFit, learn_rfid, relearn_rfid
from factorgraph_loc.sensors.rfid.calibration.rounds import distinct
from factorgraph_loc.sensors.rfid.settings import PriorSettings, default_models
from factorgraph_loc.sensors.smoothed import Traced


class RfidCalibrator(Calibrator):
    """The calibrator of RFID."""

    section, channel = "rfid", "rfid"

    def recordings(self, logs: Sequence[Log]) -> list[int]:
        """Identifiers by content: logs with the same reads are one recording."""
        return distinct(logs)

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Survey, mounting and models from logs with reads; with smoothed trajectories only the models."""
        logs = [replace(one.log, rig=rig) for one in traced]
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

    def widened(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the first priors of its detection models."""
        if rig.rfid is None or first.rfid is None:
            return rig
        priors: dict[str, PriorSettings] = {name: model.prior for name, model in first.rfid.models.items()}
        models = {name: model.model_copy(update={"prior": priors[name]}) for name, model in rig.rfid.models.items()}
        return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})

    def is_complete(self, rig: Rig) -> bool:
        """Whether a detection model was learnt or given, because the default model is uninformative."""
        return super().is_complete(rig) and (rig.rfid is None or rig.rfid.models != default_models())

    def document(self, found: SensorKnowledge, _rig: Rig) -> dict[str, Any]:
        """The models that were compared, the agreement of phases, and the share of independent reads."""
        return {"rfid": None if found.details is None else report.rfid_document(found.details)}

    def report(self, found: SensorKnowledge, _rig: Rig) -> Mapping[str, Sequence[Part]]:
        """The models, the share of independent reads, and the field around the antenna."""
        if found.details is None:
            return {}
        fit: RfidFit = found.details
        text = (
            f"Reads are correlated: {1.0 / fit.share:.1f} of them contain as much information as an independent one. The tempering "
            "of the likelihood is the inverse."
        )
        picture = "Probability of a read around the antenna (triangle): observed on the left, the model on the right."
        return {"RFID": [text, report.models_table(fit), picture, report.field_figure(fit)]}


CALIBRATOR = RfidCalibrator()
