"""The calibrator of RFID, from reads along the reference and the smoother's errors."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.drawing.pages import Part, Rows
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator, Settled, State, Told, Unit
from factorgraph_loc.sensors.rfid.calibration import report
from factorgraph_loc.sensors.rfid.calibration.learn import RfidKnowledge, learn_rfid
from factorgraph_loc.sensors.rfid.calibration.rounds import distinct
from factorgraph_loc.sensors.rfid.calibration.smoothed import relearn_rfid, with_priors
from factorgraph_loc.sensors.rfid.calibration.tempering import tempered
from factorgraph_loc.sensors.rfid.settings import RfidSettings, default_models
from factorgraph_loc.sensors.smoothed import Smoothed

PLACES, MODEL, STRENGTH = Unit("rfid", ("places",)), Unit("rfid", ("models",)), Unit("rfid", ("rssi",))
TOO_SHORT = "rejected: the logs are too short to judge it"


@dataclass(frozen=True)
class RfidFound:
    """The learnt ``sections`` of the rig and the ``knowledge``, which is None for a subset of the logs, with the result of all logs
    in ``like``. ``grids``: path of grid files."""

    sections: Mapping[str, Any]
    knowledge: RfidKnowledge | None
    like: RfidKnowledge
    grids: Path


class RfidCalibrator(Calibrator):
    """The calibrator of RFID."""

    section, channel, estimator = "rfid", "rfid", "smoother"
    folds = (3, 2)  # few, as detection models are slow to fit
    models = (MODEL,)
    is_consistent = True

    def recordings(self, logs: Sequence[Log]) -> list[int]:
        """Identifiers by content: logs with the same reads are one recording."""
        return distinct(logs)

    def learn(self, logs: Sequence[Log], rig: Rig, grids: Path | None, like: RfidFound | None) -> RfidFound | None:
        """Learn survey, mounting and models from logs with reads; for a subset with the choices made for all logs."""
        if self.channel not in logs[0].streams:
            return None
        if grids is None:
            raise ValueError("logs with reads of tags need a place for grids")
        kind = None if like is None else like.like.choice.kind
        learnt, knowledge = learn_rfid(logs, rig, grids, kind)
        told = knowledge if like is None else like.like
        assert told is not None, "all logs tell something"
        return RfidFound({"rfid": learnt.rfid, "survey": learnt.survey}, knowledge, told, grids)

    def relearn(self, smoothed: Sequence[Smoothed], rig: Rig, first: Rig, grids: Path | None) -> Settled:
        """Detection models and their priors, along smoothed trajectories."""
        if rig.rfid is None or grids is None:
            raise InputError(
                f"{smoothed[0].log.name}: its rig has no RFID antennas, expected their mounting in [rfid.antennas]"
            )
        return relearn_rfid(smoothed, rig, first, grids)

    def widened(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the first priors of its detection models."""
        if rig.rfid is None or first.rfid is None:
            return rig
        return rig.model_copy(update={"rfid": with_priors(rig.rfid, first.rfid)})

    def settle(
        self,
        found: RfidFound,
        logs: Sequence[Log],
        rig: Rig,
        accepted: Collection[str] | None,
        *,
        by_log: bool,
    ) -> Settled:
        """The result; learnt again with the input rig's tag and antenna positions if the learnt ones are rejected."""
        moved = any(offset.kept for offset in found.like.offsets)
        if accepted is None or not moved or PLACES.names[0] in accepted:
            return Settled(found.sections)
        folder = found.grids.parent / f"{found.grids.name}.unplaced"
        folder.mkdir()
        kind = found.like.choice.kind
        learnt = learn_rfid(logs, rig, folder / found.grids.name, kind, placed=False)[0]
        return Settled({"rfid": learnt.rfid, "survey": learnt.survey})

    def constant_units(self, found: RfidFound, _kept: Any, _learnt: Rig, _start: Rig) -> dict[Unit, float]:
        """No units; positions of tags and antennas are judged last."""
        return {PLACES: float("inf")} if any(offset.kept for offset in found.like.offsets) else {}

    def optional(self, learnt: Rig) -> tuple[Unit, ...]:
        """The signal strength."""
        return (STRENGTH,) if learnt.rfid is not None and learnt.rfid.rssi is not None else ()

    def mixed(self, old: Rig, new: Rig, state: State) -> dict[str, Any]:
        """Positions, models and strength, each selected separately."""
        if old.rfid is None or new.rfid is None or not state & {PLACES, MODEL, STRENGTH}:
            return {}
        models, places = (new.rfid if unit in state else old.rfid for unit in (MODEL, PLACES))
        settings: RfidSettings = models
        of_model = settings.all_antennas()
        antennas = {
            name: a.model_copy(update={"model": of_model[name].model}) for name, a in places.all_antennas().items()
        }
        strength = new.rfid.rssi if STRENGTH in state else old.rfid.rssi
        update = {"antennas": antennas, "preset": None, "rssi": strength, "phase": new.rfid.phase}
        survey = new.survey if PLACES in state else old.survey
        return {"rfid": settings.model_copy(update=update), "survey": survey}

    def usable(self, rig: Rig, state: State) -> Rig:
        """The rig; signal strength is used while it is judged, if the rig has its model."""
        known = rig.rfid is not None and rig.rfid.rssi is not None
        sensors = [name for name in rig.sensors if name != "rssi" or known]
        if STRENGTH in state and "rssi" not in sensors:
            sensors.append("rssi")
        return rig.model_copy(update={"sensors": tuple(sensors)})

    def is_complete(self, rig: Rig) -> bool:
        """Whether a detection model was learnt or given, because the default model is uninformative."""
        return super().is_complete(rig) and (rig.rfid is None or rig.rfid.models != default_models())

    def least(self, found: RfidFound) -> float:
        """The factor of the reads' scatter."""
        return float(found.like.share**-0.5)

    def inflated(self, rig: Rig, factor: float) -> Rig:
        """The rig with its tempering adjusted."""
        return tempered(rig, factor)

    def honest(self, rig: Rig, _factor: float | None, other: Rig, learnt: Rig) -> Rig:
        """The rig with the tempering and the share of dead tags from all logs."""
        if rig.rfid is None or learnt.rfid is None:
            return rig
        settings = rig.rfid.model_copy(update={"dead_tags": learnt.rfid.dead_tags})
        rig = rig.model_copy(update={"rfid": settings})
        return rig if other.rfid is None else tempered(rig, other.rfid.tempering**-0.5)

    def judged(self, found: RfidFound, judgements: Mapping[str, Any]) -> RfidFound:
        """The result with the estimator's judgement of the positions."""
        judgement = judgements.get(PLACES.names[0])
        accepted = judgement is not None and judgement.accepted
        why = TOO_SHORT if judgement is None else judgement.why
        offsets = tuple(replace(o, kept=accepted, why=why) if o.kept else o for o in found.like.offsets)
        knowledge = replace(found.like, offsets=offsets)
        return replace(found, knowledge=knowledge, like=knowledge)

    def doubts(self, found: RfidFound | None, _details: Any) -> list[str]:
        """Warnings about misplaced and dead tags."""
        if found is None:
            return []
        doubts = [
            f"Tag {tag.name} seems to be {tag.distance:.1f} m from its position in the map."
            for tag in found.like.doubts
        ]
        dead = found.like.dead
        if dead.tags:
            names = f"; believed dead, as they should have been: {', '.join(dead.believed)}" if dead.believed else ""
            doubts.append(f"{len(dead.tags)} tags of the map are never read{names}.")
        return doubts

    def document(self, told: Told) -> dict[str, Any]:
        """The content of the report."""
        if told.found is None:
            return {"rfid": None}
        return {"rfid": report.rfid_document(told.found.like, accepted=MODEL in told.accepted)}

    def tables(self, told: Told) -> list[Rows]:
        """Survey and mounting, detection models, and doubtful tags if any."""
        if told.found is None:
            return []
        found = told.found.like
        tables = [report.offsets_table(found), report.models_table(found, accepted=MODEL in told.accepted)]
        return [*tables, report.tags_table(found)] if found.doubts else tables

    def report(self, told: Told) -> dict[str, Sequence[Part]]:
        """The tables, and the accuracy of the models' predictions."""
        if told.found is None:
            return {}
        found = told.found.like
        parts: list[Part] = [
            report.tempering_text(found, told.rig),
            report.dead_text(found),
            *self.tables(told),
            "Observed frequency of reads against the probability predicted by a model that was fitted to other logs or segments.",
            report.reliability_figure(found),
            "Probability of a read around the antenna (triangle): observed on the left, the model on the right.",
            report.field_figure(found),
        ]
        return {"RFID": parts}


CALIBRATOR = RfidCalibrator()
