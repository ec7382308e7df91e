"""The page of settings is that of the models."""

from package_tables import ROOT
from settings_tables import tables

from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.fusion.registry import settings_type
from factorgraph_loc.plugins import ESTIMATORS


def test_the_page_of_settings_is_up_to_date():
    page = (ROOT / "docs" / "settings.md").read_text()
    assert page.partition("<!-- tables -->")[2].strip() == "\n".join(tables()).strip(), (
        "scripts/settings --docs docs/settings.md"
    )


def test_every_setting_of_an_estimator_has_a_meaning():
    without = [f"{name}.{s.key}" for name in ESTIMATORS for s in settings_in(settings_type(name)) if not s.meaning]
    assert not without
