"""Base class of the rig settings of sensors."""

from pathlib import Path
from typing import ClassVar, Self

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.units import Seconds
from factorgraph_loc.model.variable import Estimated


class SensorSettings(FileModel):
    """The section of a sensor in a rig. ``constants``: names of the calibration constants that may be estimated; the section's
    ``uncertainty`` holds their standard deviations."""

    constants: ClassVar[tuple[str, ...]] = ()
    time_offset: Seconds = 0.0
    """added to the timestamps"""

    def estimated(self) -> Estimated:
        """The constants that are estimated."""
        return Estimated.of(self.constants, getattr(self, "uncertainty", None))

    def placed(self, folder: Path) -> Self:
        """A copy whose file references are relative to ``folder``, which holds the rig's file."""
        return self

    def write_beside(self, folder: Path) -> None:
        """Write the files that the settings refer to into ``folder``, which holds the rig's file."""
