"""The examples of the documentation in C and Cython are built and run as described, and print the printed output."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from c_compiler import compiler
from test_docs import ROOT, assert_output

PAGE = (ROOT / "docs/tutorials/compiled-functions.md").read_text(encoding="utf-8").partition("## Functions in C")[2]
BUILD = re.compile(r"^```console\n\$ (.*)\n```$", re.MULTILINE)
PRINTED = re.compile(r"^```console\n\$ python \S+\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(
    ("k", "script"),
    [(0, "with_ctypes.py"), pytest.param(1, "with_cython.py", marks=[pytest.mark.nightly, pytest.mark.slow])],
)
def test_example(k, script, tmp_path):
    shutil.copytree(ROOT / "examples" / "c-functions", tmp_path, dirs_exist_ok=True)
    first, *rest = shlex.split(BUILD.findall(PAGE)[k])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]), "CC": shlex.join(compiler())}
    command = {"cc": compiler(), "cythonize": [sys.executable, "-m", "Cython.Build.Cythonize"]}[first]
    subprocess.run([*command, *rest], cwd=tmp_path, env=environment, check=True, capture_output=True)
    ran = [sys.executable, "-W", "error", script]
    found = subprocess.run(ran, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert found.stderr == ""
    assert_output(found.stdout, PRINTED.findall(PAGE)[k])


def test_the_page_shows_all_files():
    shown = re.findall(r"^```\{literalinclude\} \.\./\.\./(\S+)$", PAGE, re.MULTILINE)
    assert sorted(shown) == sorted(str(path.relative_to(ROOT)) for path in (ROOT / "examples/c-functions").iterdir())
    assert all(f"`{Path(path).name}`" in PAGE for path in shown)
