"""Names of the package that users import, and the pages of the docs: their links, examples, commands and outputs."""

import ast
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from page_commands import commands, not_as_shown, runnable, tables
from typer.main import get_command

import factorgraph_loc as fgloc
from factorgraph_loc.cli.app import app

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def test_the_example_of_the_readme_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(compile(example, "README.md", "exec"), {})
    assert re.fullmatch(r"\d+\.\d\d m\n", capsys.readouterr().out)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?://)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("notebook", sorted((ROOT / "docs").rglob("*.ipynb")), ids=lambda notebook: notebook.name)
def test_notebooks_are_without_results_and_use_what_is_public(notebook):
    cells = [cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, start=1):
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        tree = ast.parse("".join(cell["source"]), f"{notebook.name}, cell {number}")
        used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
        assert {node.attr for node in used if node.value.id == "fgloc"} <= set(fgloc.__all__)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_pages_have_the_options_that_they_use(page):
    for line in commands(page.read_text()):
        words = shlex.split(line, comments=True)
        if words[0] == "fgloc":
            parse(words[1:])


def parse(words):
    """Parse a line as ``fgloc`` does, without executing anything. Raises click's error for an unknown command or option."""
    command = get_command(app)
    words = words[: words.index(">")] if ">" in words else words
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, words[0]
        command, words = command.commands[words[0]], words[1:]
    command.make_parser(command.context_class(command)).parse_args(list(words))


@pytest.mark.parametrize(
    "line", ["fgloc rum plaza2", "fgloc run plaza2 -e ekf --outt here", "fgloc experiment runs night.toml"]
)
def test_wrong_commands_would_be_found(line):
    with pytest.raises(Exception, match=r"rum|--outt|runs"):
        parse(line.split()[1:])


def test_what_is_run_of_a_page_needs_no_data():
    page = """
```console
$ fgloc info hall/                  # your own
$ fgloc info hall/office-1          # made before
office-1 1200 rows
$ pip install 'factorgraph-loc[ros]'
```

```toml
$ fgloc info no-command
```
"""
    assert commands(page) == ["fgloc info hall/", "fgloc info hall/office-1", "pip install 'factorgraph-loc[ros]'"]
    assert runnable(page) == ["fgloc info hall/office-1"]


def test_a_tutorial_is_done_with_its_files_and_its_python(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ mkdir inside\n$ cd inside\n```\n```toml\n# cart.rig.toml\nname = 'cart'\n```\n```toml\nno = 'file'\n```\n"
        "```python\nfrom pathlib import Path\nPath('copy').write_text(Path('cart.rig.toml').read_text())\n```\n"
        "```console\n$ cat copy > again\n```\n"
    )
    command = [sys.executable, str(ROOT / "scripts/run_tutorial"), str(page)]
    subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (tmp_path / "inside/again").read_text() == "# cart.rig.toml\nname = 'cart'\n"
    assert sorted(path.name for path in (tmp_path / "inside").iterdir()) == ["again", "cart.rig.toml", "copy"]


PRINTED = """\
log   plaza2
span  409.5 s

rows  rate [Hz]
4091       10.0

  plaza2   ekf     0.293     0.05    280     3888    1/1
time: 0.53 ms per update (median)
"""


@pytest.mark.parametrize(
    ("shown", "told"),
    [
        (PRINTED, None),
        ("log   plaza2\n...\nrows  ...\n4091 9.9\n...\n", None),  # within 5 %
        ("...\n plaza2 ekf 0.292 0.99 999 3888 1/1\ntime: 9.99 ms per update (median)\n", None),  # how long it takes
        ("...\n plaza2 ekf 0.333 0.05 280 3888 1/1\n...\n", " plaza2 ekf 0.333 0.05 280 3888 1/1"),
        ("log   plaza2\nrows  rate [Hz]\n...\n", "rows  rate [Hz]"),
        ("log   plaza1\n...\n", "log   plaza1"),
        ("log   plaza2\nspan  409.5 s\n", "rows rate [Hz] (is printed, but not shown)"),
    ],
)
def test_what_a_page_shows_of_an_output_is_compared_with_it(shown, told):
    assert not_as_shown(shown, PRINTED) == told


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_of_toml_are_toml(page):
    for block in tables(page.read_text()):
        tomllib.loads(block)


EXAMPLES = [*sorted((ROOT / "scripts").glob("example_*")), ROOT / "scripts/ros2_node_example"]
DETAILS = re.findall(r"automodule:: (\S+)\n   :members:(.*)", (ROOT / "docs/api.md").read_text())


@pytest.mark.parametrize("name", fgloc.__all__)
def test_every_name_is_there_and_documented(name):
    value = getattr(fgloc, name)
    assert f"`{name}`" in (ROOT / "docs/api.md").read_text().split("## In detail")[0]
    module = getattr(value, "__module__", None)
    if isinstance(value, type) or callable(value):
        assert value.__doc__
        listed = [members for shown, members in DETAILS if module == shown or module.startswith(f"{shown}.")]
        assert any(not members.strip() or name in re.split(r",\s*", members.strip()) for members in listed)


def test_names_cost_nothing_until_they_are_used():
    code = (
        "import sys, factorgraph_loc as fgloc\n"
        "assert set(fgloc.__all__) <= set(dir(fgloc))\n"
        "from factorgraph_loc import InputError\n"
        "assert {'numpy', 'gtsam', 'pydantic', 'polars'}.isdisjoint(sys.modules)\n"
        "from factorgraph_loc import VelocityOdometry\n"
        "assert {'gtsam', 'polars'}.isdisjoint(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_run_on_the_floor_loads_no_optimizers_and_no_rotations_of_scipy(tmp_path):
    fgloc.write_native(fgloc.simulate("office", changes={"drive": {"duration": 4.0}}), tmp_path / "log")
    code = (
        "import sys, factorgraph_loc as fgloc\n"
        "fgloc.run(fgloc.load(sys.argv[1])[0], 'dead_reckoning')\n"
        "assert {'scipy.optimize', 'scipy.spatial', 'matplotlib', 'typer'}.isdisjoint(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "log"], check=True)


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.name)
def test_examples_import_from_the_package_alone(script):
    found = re.findall(r"^(?:from|import) ((?:factorgraph_loc|factors)\S*)", script.read_text(), re.MULTILINE)
    assert set(found) == {"factorgraph_loc"}


def test_several_logs_are_not_one():
    both = {"run": "1,2"}
    assert [log.name for log in fgloc.load("plaza2", options=both)] == ["plaza2-run1", "plaza2-run2"]
    with pytest.raises(fgloc.InputError, match="plaza2 refers to 2 logs, expected one: plaza2-run1, plaza2-run2"):
        fgloc.read_log("plaza2", options=both)
