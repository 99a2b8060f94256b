"""Names that `import eip_scipy` provides, and names that are loaded on first use."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import eip_scipy

HEAVY = ["eip_scipy_studies", "matplotlib", "numba", "scipy", "tqdm"]
HEAVY_FOR_STEPS = ["dask", "matplotlib", "scipy.ndimage", "scipy.signal", "scipy.stats", "skimage", "tqdm"]


def python(code, *arguments):
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def loaded(code, names):
    """Return the modules that are loaded in a fresh process after `code`."""
    return python(f"{code}\nimport sys\nprint(*(name for name in {names} if name in sys.modules))").split()


def test_the_package_alone_is_light():
    found = python("import eip_scipy, sys\nprint(*sys.modules)").split()
    assert set(found).isdisjoint(HEAVY)
    own = {name for name in found if name.startswith("eip_scipy.")}
    assert own == set()


def test_names_bring_no_more_than_they_need():
    """Numba is not loaded either; a module that another one loads would be there at the end."""
    names = "EIPRK4, EIPDOP853, Invariant, Diagnostics, project, integrate, ensemble, problems"
    assert loaded(f"from eip_scipy import {names}", [*HEAVY_FOR_STEPS, "llvmlite", "numba"]) == []
    unused = ["eip_scipy.ensembles", "eip_scipy.problems"]
    assert loaded("from eip_scipy import EIPRK4, Invariant, integrate", unused) == []


def test_no_name_brings_the_studies():
    """Neither the public names nor the public modules load the studies; `python -m eip_scipy` does."""
    modules = "checkpoint, integrations, methods, plotting, problems, results, solvers"
    assert loaded(f"from eip_scipy import *\nfrom eip_scipy import {modules}", ["eip_scipy_studies"]) == []
    assert loaded("import eip_scipy.__main__", ["eip_scipy_studies", "numpy"]) == ["eip_scipy_studies"]


def test_all_public_names_are_there():
    assert len(eip_scipy.__all__) <= 31
    for name in eip_scipy.__all__:
        assert getattr(eip_scipy, name).__name__ == name
    assert {*eip_scipy.__all__, "__version__", "checkpoint", "problems"} <= set(dir(eip_scipy))


def test_names_modules_and_version_come_by_name():
    code = "import eip_scipy as e\nprint(e.problems.kepler.__name__, e.checkpoint.read.__name__, e.__version__)"
    code += "\nfrom eip_scipy import *\nprint(EIPRK4.__name__, __name__)"
    assert python(code).split() == ["kepler", "read", eip_scipy.__version__, "EIPRK4", "__main__"]


def test_a_subinterpreter_is_refused():
    """Before NumPy is imported; the main interpreter is as it was."""
    code = """
import sys
interpreters = __import__("_interpreters" if sys.version_info >= (3, 13) else "_xxsubinterpreters")
run = interpreters.exec if sys.version_info >= (3, 13) else interpreters.run_string
run(interpreters.create(), '''
try:
    import eip_scipy
except ImportError as error:
    print(error, flush=True)
import sys
print("numpy" in sys.modules, flush=True)
''')
from eip_scipy import Invariant
print(Invariant.__name__)"""
    *message, loaded, name = python(code).split()
    assert " ".join(message[:6]) == "eip_scipy was imported in a subinterpreter,"
    assert {"threads", "processes"} <= {*message}
    assert (loaded, name) == ("False", "Invariant")


def test_no_folder_or_module_has_a_public_name():
    """Importing such a module would replace the function, which is only available by its name."""
    here = Path(eip_scipy.__file__).parent
    assert {path.stem for path in here.iterdir()} & {*eip_scipy.__all__} == set()


@pytest.mark.parametrize(("package", "extra"), [("rebound", "rebound"), ("astropy", "astro")])
def test_a_missing_package_says_how_to_get_it(package, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"eip_scipy.integrations.{package}", raising=False)
    with pytest.raises(ImportError, match=rf'pip install "eip_scipy\[{extra}\]"'):
        importlib.import_module(f"eip_scipy.integrations.{package}")


def test_no_other_name_is_looked_for_in_the_studies():
    with pytest.raises(AttributeError, match="no attribute 'EIPRK7'"):
        eip_scipy.EIPRK7  # noqa: B018
    for code in ("import eip_scipy.problems.soft_cases", "from eip_scipy.plotting import no_figure"):
        with pytest.raises(ImportError):
            exec(code)
