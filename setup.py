"""The packages, with the folder ``datasets`` as ``factorgraph_loc.datasets``, and the long description.

The long description is the README, with links and images that lead to the repository as it was tagged.
"""

import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup


def text(path: str) -> str:
    """What a file of the project says."""
    return (Path(__file__).parent / path).read_text(encoding="utf-8")


def long_description() -> str:
    """The text of README.md with the addresses of its pages and images in place of paths."""
    repository = tomllib.loads(text("pyproject.toml"))["project"]["urls"]["Repository"]
    (version,) = re.findall(r'^__version__ = "(.+)"$', text("factorgraph_loc/version.py"), re.MULTILINE)
    with_images = re.sub(r"(!\[[^\]]*\]\()(?!https?:)", rf"\g<1>{repository}/raw/v{version}/", text("README.md"))
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!https?:)", rf"\g<1>{repository}/blob/v{version}/", with_images)


setup(
    packages=[*find_packages(include=["factorgraph_loc*", "factors*"]), "factorgraph_loc.datasets"],
    package_dir={"factorgraph_loc.datasets": "datasets"},
    long_description=long_description(),
    long_description_content_type="text/markdown",
)
