"""Members of an ensemble on the ranks of MPI, by the script of the documentation."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eip_scipy import ensemble, load
from eip_scipy.problems import kepler

pytest.importorskip("mpi4py", reason="needs mpi4py: pip install mpi4py mpich")
PAGE = Path(__file__).parents[2] / "docs/how-to/own-methods.md"
LAUNCHER = shutil.which("mpiexec") or shutil.which("mpiexec", path=str(Path(sys.executable).parent))


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [None, 3])
def test_the_script_of_the_page(ranks, tmp_path):
    """Run it as it is, and with functions of the script itself; results are those of threads."""
    if LAUNCHER is None:
        pytest.skip("needs an MPI launcher")
    script = re.search(r"```py\n(# sweep.py\n.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    own = "def highest(result):\n    return result.y[0].max()\n\nif __name__"
    script = script.replace("if __name__", own, 1).replace("executor=executor", "executor=executor, reduce=highest")
    (tmp_path / "sweep.py").write_text(script + '    run.save("run.npz")\n', encoding="utf-8")
    command = [sys.executable, "sweep.py"]
    if ranks:
        command = [LAUNCHER, "-n", str(ranks), sys.executable, "-m", "mpi4py.futures", "sweep.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Ensemble: 1000 members")
    starts = kepler().y0 * np.linspace(0.98, 1.02, 1000)[:, None]
    here, there = ensemble(kepler(), (0, 60), starts, h=0.03), load(tmp_path / "run.npz")
    np.testing.assert_array_equal(there.y, here.y)
    assert np.isfinite(there.reduced).all()
