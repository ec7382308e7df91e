"""What the settings of all sensors have in common."""

from pathlib import Path
from typing import ClassVar, Self

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.units import Seconds
from factorgraph_loc.model.variable import Estimated


class SensorSettings(FileModel):
    """The section of a sensor in a rig. ``time_offset`` [s] is added to its stamps. ``constants``: the names of those that may be
    learnt on the way; the section's ``uncertainty`` has a field for each that can be, its standard deviation."""

    constants: ClassVar[tuple[str, ...]] = ()
    time_offset: Seconds = 0.0

    def estimated(self) -> Estimated:
        """Which of its ``constants`` are learnt on the way."""
        return Estimated.of(self.constants, getattr(self, "uncertainty", None))

    def placed(self, folder: Path) -> Self:
        """The same, of a rig whose file is in ``folder``."""
        return self

    def write_beside(self, folder: Path) -> None:
        """Write the files that it names into the ``folder`` of the rig's file."""
