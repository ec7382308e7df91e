"""The page of settings is that of the models."""

from package_tables import ROOT
from settings_tables import tables

from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.fusion.registry import settings_type
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ESTIMATORS
from factorgraph_loc.simulation import SimulationSettings


def test_the_page_of_settings_is_up_to_date():
    page = (ROOT / "docs" / "settings.md").read_text()
    assert page.partition("<!-- tables -->")[2].strip() == "\n".join(tables()).strip(), (
        "scripts/settings --docs docs/settings.md"
    )


def test_every_setting_has_a_meaning():
    models = {name: settings_type(name) for name in ESTIMATORS}
    models |= {"rig": Rig, "simulation": SimulationSettings, "active": ActiveSettings}
    assert not [f"{name}.{s.key}" for name, model in models.items() for s in settings_in(model) if not s.meaning]
