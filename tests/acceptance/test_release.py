"""Statements of a release: one version everywhere, safe reading of data, the pages of changes, the wheels."""

import ast
import importlib
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import eip_scipy

ROOT = Path(__file__).parents[2]
SOURCES = sorted(path for folder in ("eip_scipy", "integrations", "studies") for path in (ROOT / folder).rglob("*.py"))
UNPICKLES = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "runpy"}


def test_one_version():
    version = eip_scipy.__version__
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    logged = re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited[1] == logged[1] == version
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"]["attr"] == "eip_scipy.core.versions.VERSION"


def forbidden(tree):
    """Yield calls in a module that read data as code: imports, calls, NumPy's pickles."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from {alias.name.partition(".")[0] for alias in node.names} & UNPICKLES
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from {node.module.partition(".")[0]} & UNPICKLES
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec"):
            yield node.func.id
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
            yield "allow_pickle"


def test_no_data_is_run():
    """The package keeps the promise of SECURITY.md."""
    found = {str(path): [*forbidden(ast.parse(path.read_text(encoding="utf-8")))] for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "text", ["import pickle", "from marshal import loads", "eval('1')", "np.load(path, allow_pickle=True)"]
)
def test_what_is_forbidden_is_seen(text):
    assert [*forbidden(ast.parse(text))]


def test_configuration(capsys):
    found = eip_scipy.show_config("dicts")
    assert found["versions"]["eip_scipy"] == eip_scipy.__version__
    assert found["engine"]["compiler"]
    assert capsys.readouterr().out == ""
    eip_scipy.show_config()
    text = capsys.readouterr().out
    assert all(name in text for name in (found["engine"]["build"], found["engine"]["compiler"], *found["extras"]))
    with pytest.raises(ValueError, match=r"mode must be 'stdout' or 'dicts', got 'json'\."):
        eip_scipy.show_config("json")


def test_wheels_are_listed(monkeypatch):
    """The page Installation has a row for each wheel that building/wheels.py makes."""
    monkeypatch.syspath_prepend(ROOT)
    monkeypatch.setitem(
        sys.modules, "lief", ModuleType("lief")
    )  # which reads libraries, and only the wheels' builder needs
    made = importlib.import_module("building.wheels").WHEELS
    page = (ROOT / "docs/install.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(cp[^`]+)` \|", page, re.MULTILINE)) == sorted(made)
