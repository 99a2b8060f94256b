"""The Python code of the documentation runs as printed, and prints the output below it."""

import doctest
import inspect
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from pydoc import locate

import pytest
from c_compiler import compiler

pytestmark = pytest.mark.needs_jit

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```(python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"^```(?:python|py|diff|console|\{code-cell\} ipython3)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COLUMN = 88
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
ROUND_OFF = 1e-9


def agree(found, printed):
    """Compare numbers to 10 %, or both at the level of round-off, which differs from machine to machine."""
    return math.isclose(found, printed, rel_tol=0.1) or max(abs(found), abs(printed)) < ROUND_OFF


def assert_output(found, printed):
    assert NUMBER.sub("#", found).split() == NUMBER.sub("#", printed).split()
    for a, b in zip(NUMBER.findall(found), NUMBER.findall(printed), strict=True):
        assert agree(float(a), float(b)), f"{a}, printed as {b}"


# Packages of single sections, which are left out if theirs is missing.
OF_SECTIONS = {
    "docs/how-to/mechanisms.md": ("pydy",),
    "docs/how-to/fitting.md": ("jax", "torch"),
    "docs/how-to/own-methods.md": ("gala", "galpy", "qutip"),
}
# These take six seconds or more each; quicker tests of the same methods run in the gate.
NIGHTLY = (
    "results/solar-system", "results/charged-particles", "results/gross-pitaevskii", "how-to/write-only-h",
    "how-to/balances", "how-to/tangent-maps", "how-to/stiff-systems", "how-to/recommend", "explanation/choosing",
    "how-to/variable-steps",
)  # fmt: skip


PAGES = [path for path in sorted((ROOT / "docs").glob("[a-z]*/*.md")) if "\n```python\n" in path.read_text("utf-8")]


def with_marks(path):
    page = path.relative_to(ROOT).as_posix()
    nightly = [pytest.mark.nightly] * any(name in page for name in NIGHTLY)
    return pytest.param(page, marks=[pytest.mark.slow, *nightly])


@pytest.mark.parametrize("page", ["README.md", *map(with_marks, PAGES)])
def test_page(page, capsys, tmp_path, monkeypatch):
    """Run all blocks of a page in turn, in one namespace; a block of text is the output of the code before it."""
    monkeypatch.chdir(tmp_path)  # where pages write their files
    path = ROOT / page
    text = path.read_text(encoding="utf-8")
    for package in (name for name in OF_SECTIONS.get(page, ()) if find_spec(name) is None):
        section = re.compile(rf"^##+ \w*{package}\b.*?(?=^##|\Z)", re.IGNORECASE | re.MULTILINE | re.DOTALL)
        text = section.sub(lambda m: "\n" * m[0].count("\n"), text)
    namespace = {"__name__": path.stem}
    for block in BLOCK.finditer(text):
        language, code = block.groups()
        if language == "text":
            assert_output(capsys.readouterr().out, code)
            continue
        capsys.readouterr()
        line = text.count("\n", 0, block.start(2))
        exec(compile("\n" * line + code, str(path), "exec"), namespace)


def test_a_wrong_output_is_seen():
    assert_output("error 2.40e-05, residual 3e-15 [1, 2]\n", "error 2.4e-05, residual 8e-16  [1, 2]")
    for wrong in ("error 2.7e-05, residual 8e-16 [1, 2]", "error 2.4e-05, residual 8e-8 [1, 2]", "error 2.4e-05"):
        with pytest.raises(AssertionError):
            assert_output("error 2.4e-05, residual 3e-15 [1, 2]", wrong)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_lead_somewhere(page):
    """Sphinx checks the links between its own pages."""
    text = re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", text)
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_links_have_a_text():
    """Sphinx fills in the title of a link without one, and readers of the file itself see no link."""
    pages = [page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts]
    assert pages
    assert [page.name for page in pages if "[](" in page.read_text(encoding="utf-8")] == []


def test_code_fits_the_column():
    """Lines of more characters are cut off at the edge of a page on a screen of 1400 pixels."""
    pages = (*(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md"))
    long = [
        f"{page.name}: {line}"
        for page in pages
        if not {"_build", "generated", "notebooks"} & set(page.parts)
        for block in CODE.finditer(page.read_text(encoding="utf-8"))
        for line in block[1].splitlines()
        if len(line) > COLUMN
    ]
    assert long == []


def test_notebooks_are_listed():
    """Each notebook is on the documentation's page; `.ci/run` executes them."""
    notebooks = sorted((ROOT / "examples").glob("*.md"))
    assert notebooks
    page = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    for notebook in notebooks:
        text = notebook.read_text(encoding="utf-8")
        assert text.startswith("---\njupytext:\n")
        title = re.search(r"^# (.+)$", text, re.MULTILINE)[1]
        assert f"| [{title}](notebooks/{notebook.stem}) |" in page
        assert f"\nnotebooks/{notebook.stem}\n" in page


# The examples in C and Cython are built and run as described, and print the printed output.
C_PAGE = (ROOT / "docs/tutorials/compiled-functions.md").read_text(encoding="utf-8").partition("## Functions in C")[2]
BUILD = re.compile(r"^```console\n\$ (.*)\n```$", re.MULTILINE)
PRINTED = re.compile(r"^```console\n\$ python \S+\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(
    ("k", "script"),
    [(0, "with_ctypes.py"), pytest.param(1, "with_cython.py", marks=[pytest.mark.nightly, pytest.mark.slow])],
)
def test_example_in_c(k, script, tmp_path):
    shutil.copytree(ROOT / "examples" / "c-functions", tmp_path, dirs_exist_ok=True)
    first, *rest = shlex.split(BUILD.findall(C_PAGE)[k])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]), "CC": shlex.join(compiler())}
    command = {"cc": compiler(), "cythonize": [sys.executable, "-m", "Cython.Build.Cythonize"]}[first]
    subprocess.run([*command, *rest], cwd=tmp_path, env=environment, check=True, capture_output=True)
    ran = [sys.executable, "-W", "error", script]
    found = subprocess.run(ran, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert found.stderr == ""
    assert_output(found.stdout, PRINTED.findall(C_PAGE)[k])


def test_the_page_on_c_shows_all_files():
    shown = re.findall(r"^```\{literalinclude\} \.\./\.\./(\S+)$", C_PAGE, re.MULTILINE)
    assert sorted(shown) == sorted(str(path.relative_to(ROOT)) for path in (ROOT / "examples/c-functions").iterdir())
    assert all(f"`{Path(path).name}`" in C_PAGE for path in shown)


# Results and errors: their examples are those of the functions that return them.
RETURNED = re.compile(r"Result$|Error$|Multipliers|Recommendation|Transits|_time$|reaches|require_same|warn_of")


def public():
    """Return the public functions and classes by their names, each once."""
    found = {"plotting.map": locate("eip_scipy.plotting.map")}
    for module in ("", "problems.", "chaos.", "results.", "checkpoint."):
        for name in locate(f"eip_scipy.{module}".strip(".")).__all__:
            item = locate(f"eip_scipy.{module}{name}")
            if (inspect.isroutine(item) or inspect.isclass(item)) and item not in found.values():
                found[module + name] = item
    return found


@pytest.mark.parametrize("name", public())
def test_a_public_name_is_documented(name):
    """It has a section See Also, whose names exist, and an example that runs."""
    item, place = public()[name], ".".join(["eip_scipy", *name.split(".")[:-1]])
    related = re.search(r"^See Also\n-+\n(.+?)(?:\n\n|\Z)", inspect.getdoc(item), re.MULTILINE | re.DOTALL)[1]
    names = [word.strip() for word in related.split(",")]
    assert [other for other in names if not (locate(other) or locate(f"{place}.{other}"))] == []
    (test,) = doctest.DocTestFinder(recurse=False).find(item, name, globs={}) or [None]
    assert test.examples or RETURNED.search(name)
    assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test).failed == 0
