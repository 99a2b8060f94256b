"""Every measurement, ``eip-scipy study NAME``, says what it takes, and runs through with small settings."""

import os
import shlex
import subprocess
import sys
from importlib import import_module

import pytest

from eip_scipy_studies.cli import main
from eip_scipy_studies.commands import COMMANDS
from eip_scipy_studies.report import UsageError, needed
from eip_scipy_studies.timing import clocked, least, many_calls

pytestmark = pytest.mark.needs_jit

# Each measurement with its arguments, and with the modules without which it only says how they are installed.
HEYOKA, REBOUND, REBOUNDX = ("heyoka",), ("rebound",), ("heyoka", "rebound", "reboundx")
RUNS = [
    ("bodies", "--periods 2 --bodies 10 --json run.json", REBOUND),
    ("charged-particle", "--quick --json run.json", ()),
    ("ensembles", "--members 10 --steps 100 --repeats 1 --largest 10 --json run.json", ()),
    ("exoplanets", "--share 0.002 --json run.json", REBOUNDX),
    ("gpe-efficiency", "--points 16 --repeats 1 --json run.json", ()),
    ("long-orbits", "--years 1 --json run.json", ()),
    ("multistep", "--quick --parts 1 2 4 --json run.json", REBOUND),
    ("multistep", "--quick --parts 3 --json run.json", HEYOKA),
    ("recommend", "--cases pendulum --json run.json", ()),
    ("relativity", "--years 1 --json run.json", REBOUNDX),
    ("solar-cloud", "--members 16 --years 1 --sample 2 --json run.json", REBOUND),
    ("speed", "--quick --json run.json", ()),
    ("stiff", "--quick --json run.json", ()),
    ("trust", "--only pendulum --json run.json", ()),
]
NAMES = sorted({name for name, *_ in RUNS})


def test_every_study_is_listed():
    assert sorted(name.removeprefix("study ") for name in COMMANDS if name.startswith("study ")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_help(name, capsys):
    """The help is printed, or the way to install a required package."""
    status = main(["study", name, "--help"])
    shown = capsys.readouterr()
    if status == 0:
        assert shown.out.startswith(f"usage: eip-scipy study {name}")
    else:
        assert "pip install" in shown.err
        assert not installed(needs(name))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("name", "arguments", "modules"), RUNS, ids=[f"{name} {words}" for name, words, _ in RUNS])
def test_small_run(name, arguments, modules, tmp_path):
    command = [sys.executable, "-m", "eip_scipy", "study", name, *shlex.split(arguments)]
    run = subprocess.run(command, cwd=tmp_path, env={**os.environ, "MPLBACKEND": "Agg"}, capture_output=True, text=True)
    if installed(modules):
        assert run.returncode == 0, run.stderr
        assert run.stdout
        assert (tmp_path / "run.json").exists()
    else:
        assert run.returncode == 2
        assert "Traceback" not in run.stderr
        assert "pip install" in run.stderr


def test_what_is_needed_says_how_it_is_installed():
    with pytest.raises(UsageError, match="pip install no-such-package"):
        needed("no_such_package", "no-such-package")
    with pytest.raises(ImportError, match="no_such_module"):
        needed("eip_scipy.no_such_module")


def test_least_times_are_taken_in_turn():
    order = []
    actions = {name: lambda name=name: order.append(name) or float(len(order)) for name in "ab"}
    assert least(actions, turns=3) == {"a": 1.0, "b": 2.0}
    assert order == list("ababab")
    assert least(actions, seconds=1e-9) == {"a": 7.0, "b": 8.0}
    calls = []
    assert 0 <= clocked(lambda: calls.append(1))() < 1
    assert len(calls) == 1
    assert 0 <= many_calls(lambda: calls.append(1))() < 1
    assert len(calls) > 4


def needs(name):
    return {module for script, _, modules in RUNS if script == name for module in modules}


def installed(modules):
    try:
        for module in modules:
            import_module(module)
    except ImportError:
        return False
    return True
