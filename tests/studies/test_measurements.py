"""Every benchmark tells what it takes, and runs through with small settings."""

import os
import runpy
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

pytestmark = pytest.mark.needs_jit

FOLDER = Path(__file__).parents[2] / "benchmarks"
# By script: what each run of it is given, and the modules without which it only says how they are installed.
HEYOKA, REBOUND, REBOUNDX = ("heyoka",), ("rebound",), ("heyoka", "rebound", "reboundx")
RUNS = [
    ("bodies", "--periods 2 --bodies 10", REBOUND),
    ("charged_particle", "--quick --out . --json run.json", ()),
    ("ensembles", "--members 10 --steps 100 --repeats 1 --largest 10 --out .", ()),
    ("exoplanets", "--share .002 --json run.json", REBOUNDX),
    ("gpe", "--quick --json run.json --figure run.png", ()),
    ("gpe_efficiency", "--points 16 --repeats 1 --out .", ()),
    ("gpe_methods", "--points 64 --t-end .01 --repeats 1 --only RK4-EIP s6-EIP --csv run.csv", ()),
    ("gpe_mpi", "--quick --json run.json", ("eip_scipy.integrations.mpi",)),
    ("gradients", "--repeats 1 --json run.json", ()),
    ("growth", "--years 1 --out .", REBOUND),
    ("import_time", "--rounds 1 --json run.json", ()),
    ("long_orbits", "--years 1 --json run.json", ()),
    ("metric_memory", "--only gear --json run.json", ()),
    ("metric_table", "--years 100 --rotations 1 --json run.json", ()),
    ("multistep", "--quick --parts 1 3 --json run.json", REBOUND),
    ("multistep", "--quick --parts 2 4 5 --json run.json", REBOUNDX),
    ("nystrom_defaults", "--system figure-eight --json run.json", ()),
    ("overhead", "--pairs 1 --json run.json", ()),
    ("particle_references", "--bits 64 --points 2 --out run.json", HEYOKA),
    ("recommend", "--cases pendulum --json run.json", ()),
    ("relativity", "--years 1 --json run.json", REBOUNDX),
    ("ring_grids", "--quick --csv run.csv", ()),
    ("rotations", "--rotations 1 --years 10 1 --json run.json", REBOUND),
    ("scene_references", "--bits 64 --out run.json", HEYOKA),
    ("solar_cloud", "--members 16 --years 1 --sample 2 --json run.json", REBOUND),
    ("solar_reference", "--years 1 --json run.json", HEYOKA),
    ("speed", "--quick --json run.json", ()),
    ("trust", "--only pendulum --workers 1 --markdown run.md --csv run.csv --json run.json", ()),
    ("waves", "--quick --json run.json --figure run.png", ()),
    ("with_and_without", "--figure run.png", ()),
    ("written", "--quick --json run.json", ()),
]
NAMES = sorted({name for name, *_ in RUNS})


def test_every_script_is_listed():
    scripts = {path.stem for path in FOLDER.glob("*.py") if "__main__" in path.read_text(encoding="utf-8")}
    assert set(NAMES) == scripts


@pytest.mark.parametrize("name", NAMES)
def test_help(name, monkeypatch, capsys):
    """Or which command brings what it cannot do without."""
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    if end.value.code == 0:
        assert capsys.readouterr().out.startswith(f"usage: {name}.py")
    else:
        assert "pip install" in end.value.code
        assert not installed(needed(name))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("name", "arguments", "modules"), RUNS, ids=[f"{name} {words}" for name, words, _ in RUNS])
def test_small_run(name, arguments, modules, tmp_path):
    command = [sys.executable, str(FOLDER / f"{name}.py"), *shlex.split(arguments)]
    run = subprocess.run(command, cwd=tmp_path, env={**os.environ, "MPLBACKEND": "Agg"}, capture_output=True, text=True)
    if installed(modules):
        assert run.returncode == 0, run.stderr
        assert run.stdout
    else:
        assert run.returncode == 1
        assert "Traceback" not in run.stderr
        assert "pip install" in run.stderr


def needed(name):
    return {module for script, _, modules in RUNS if script == name for module in modules}


def installed(modules):
    try:
        for module in modules:
            import_module(module)
    except ImportError:
        return False
    return True
