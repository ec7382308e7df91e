"""What the scripts of a release refuse, and what is said where an extra is missing."""

import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from package_tables import MODULES, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ADDRESS = PROJECT["urls"]["Repository"]
CHANGES = "# Changes\n\n## 2.1.0 (2027-03-01)\n\n- New.\n\n## 2.0.0 (2027-02-01)\n"


@pytest.fixture
def check(tmp_path):
    """Run scripts/check_release in a tree with the version 2.1.0, with files (path: text) in place of good ones."""
    good = {
        "factorgraph_loc/version.py": '__version__ = "2.1.0"\n',
        "CHANGELOG.md": CHANGES,
        "pyproject.toml": f'[project.urls]\nRepository = "{ADDRESS}"\n',
        "CITATION.cff": f"repository-code: {ADDRESS}\n",
    }

    def run(*tag, files=None, **environment):
        for path, text in (good | (files or {})).items():
            (tmp_path / path).parent.mkdir(exist_ok=True)
            (tmp_path / path).write_text(text)
        (tmp_path / "scripts").mkdir(exist_ok=True)
        script = shutil.copy(ROOT / "scripts" / "check_release", tmp_path / "scripts")
        outside = {key: value for key, value in os.environ.items() if key != "GITHUB_REPOSITORY"}
        done = subprocess.run(
            [sys.executable, script, *tag], env=outside | environment, capture_output=True, text=True, check=False
        )
        assert done.stderr == ""
        assert done.returncode == bool(done.stdout)
        return done.stdout

    return run


def test_a_complete_version_can_be_published(check):
    assert check() == ""
    assert check("v2.1.0", GITHUB_REPOSITORY=ADDRESS.removeprefix("https://github.com/")) == ""


@pytest.mark.parametrize("tag", ["v2.1.1", "2.1.0"])
def test_a_tag_that_is_not_the_version_is_refused(check, tag):
    assert check(tag).startswith(f"the tag is {tag}, but factorgraph_loc/version.py says 2.1.0: expected v2.1.0")


@pytest.mark.parametrize(
    ("path", "text", "told"),
    [
        ("CHANGELOG.md", CHANGES.replace("2027-03-01", "unreleased"), "begins with ## 2.1.0 (unreleased), expected"),
        ("CHANGELOG.md", CHANGES.replace("## 2.1.0 (2027-03-01)", ""), "expected '## 2.1.0 (YYYY-MM-DD)'"),
        ("CITATION.cff", "repository-code: https://example.org\n", "CITATION.cff: repository-code is not that of"),
        ("factorgraph_loc/version.py", '__version__ = "2.1.0.dev1"\n', "the version is 2.1.0.dev1, expected three"),
    ],
)
def test_what_is_not_finished_is_told_of(check, path, text, told):
    assert told in check(files={path: text})


def test_another_repository_does_not_publish(check):
    expected = f"pyproject.toml: [project.urls] names {ADDRESS}, expected https://github.com/some/fork\n"
    assert check(GITHUB_REPOSITORY="some/fork") == expected


def test_the_project_names_one_address():
    assert f"repository-code: {ADDRESS}\n" in (ROOT / "CITATION.cff").read_text()


def test_messages_and_pages_name_extras_that_exist():
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    named = {
        path: {
            extra
            for found in re.findall(r"factorgraph-loc\[([\w,]+)\]", path.read_text())
            for extra in found.split(",")
        }
        for path in (*MODULES.values(), *pages)
    }
    assert {extra for path in MODULES.values() for extra in named[path]} == {"cluster", "ros", "viewer"}
    assert set().union(*named.values()) <= set(PROJECT["optional-dependencies"])
