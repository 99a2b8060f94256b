"""The figure of a run is shown in notebooks, in windows, and in axes of the user."""

import sys
import types

import numpy as np
import pytest

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import kepler
from eip_scipy.results import plot

pyplot = pytest.importorskip("matplotlib.pyplot")
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def run():
    return integrate(kepler(), (0, 10), method=EIPRK4, save_every=5)


@pytest.fixture
def windows():
    """Use a backend whose figures have invisible windows."""
    from matplotlib.backend_bases import FigureManagerBase
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    class Canvas(FigureCanvasAgg):
        manager_class = FigureManagerBase

    name, before = "windows_that_nobody_sees", pyplot.get_backend()
    backend = types.ModuleType(name)
    backend.FigureCanvas, backend.FigureManager = Canvas, FigureManagerBase
    sys.modules[name] = backend
    pyplot.switch_backend(f"module://{name}")
    yield pyplot
    pyplot.close("all")
    pyplot.switch_backend(before)
    del sys.modules[name]


def test_without_windows_nobody_keeps_the_figure(run):
    before = pyplot.get_fignums()
    figures = [run.plot() for _ in range(3)]
    assert pyplot.get_fignums() == before
    assert figures[0]._repr_png_()[:4] == PNG


def test_pyplot_shows_the_figure_in_a_window(run, windows):
    figure = run.plot()
    assert windows.gcf() is figure
    # The window shows it, so that a notebook needs no other picture.
    assert figure._repr_png_() is None
    windows.close(figure)
    assert figure._repr_png_()[:4] == PNG


def test_windows_do_not_add_up(run, windows, tmp_path, monkeypatch):
    """At most as many figures are open as matplotlib allows before it warns, which is an error in these tests."""
    monkeypatch.setitem(windows.rcParams, "figure.max_open_warning", 4)
    own = windows.figure()
    figures = [run.plot() for _ in range(6)]
    assert len(windows.get_fignums()) == 4
    assert windows.fignum_exists(own.number)
    assert windows.gcf() is figures[-1]
    figures[0].savefig(tmp_path / "first.png")
    assert (tmp_path / "first.png").read_bytes()[:4] == PNG


def test_axes_of_the_user(run):
    figure, (left, right) = pyplot.subplots(1, 2)
    assert run.plot(ax=left) is left
    np.testing.assert_array_equal(left.lines[0].get_xydata(), run.y[:2].T)
    assert left.get_title() == "EIPRK4, h = 0.03"
    right.set_title("my own")
    assert plot(run, "q1 q2 p1 p2", ax=right) is right
    assert [line.get_label() for line in right.lines] == ["q1", "q2", "p1", "p2"]
    assert right.get_title() == "my own"
    assert figure.axes == [left, right]
    pyplot.close(figure)
