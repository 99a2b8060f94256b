"""The page that plays a run: its content and, if a Chromium is installed, its display."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib import image
from scipy.integrate import solve_ivp
from systems import oscillator

from eip_scipy import EIPDOP853, EIPRK4, equations, integrate, load
from eip_scipy.problems import harmonic, kepler, soliton
from eip_scipy.results import IntegrationResult, view
from eip_scipy.run import view as module
from eip_scipy_studies.cli import main

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
Y0 = np.array([1.0, 2.0])


def circling(t_end=20.0, **options):
    problem = kepler(0.6, relativistic=0.0)
    return integrate(problem, (0, t_end), **{"method": EIPRK4, "h": 0.03, "save_every": 2, **options})


def content(text):
    return json.loads(re.search(r'<script id="run" type="application/json">(.*?)</script>', text, re.DOTALL)[1])


def of(run, **options):
    return content(module.page(run, **options))


def test_orbit_with_its_errors(tmp_path):
    run = circling()
    path = run.view(tmp_path / "kepler.html")
    found = content(path.read_text(encoding="utf-8"))
    assert found["title"] == "EIPRK4, h = 0.03"
    assert (found["message"], found["doubt"]) == (run.message, "")
    assert found["t"] == pytest.approx(run.t, rel=1e-8)
    assert found["state"]["kind"] == "orbits"
    assert found["state"]["rows"][0]["x"] == pytest.approx(run.y[0], rel=1e-4)
    invariants, trajectory = found["errors"]
    assert invariants["names"] == ["H", "L"]
    errors = np.abs(run.invariants - run.target[:, None])
    np.testing.assert_allclose(invariants["rows"], errors, rtol=1e-2)
    reference = np.array([kepler(0.6, relativistic=0.0).reference(t) for t in run.t]).T
    expected = np.hypot(*(run.y - reference)[:2])
    np.testing.assert_allclose(trajectory["rows"][0], expected, rtol=1e-2)


def test_a_reference_is_of_the_same_problem():
    """Errors are not known for another start, for other parameters, or from the run's own numbers alone."""
    same = {"method": EIPRK4, "h": 0.1, "save_every": 1}
    problem = kepler(0.6, relativistic=0.0)
    for run in (
        integrate(problem, (0, 1), 1.01 * problem.y0, **same),
        integrate(problem, (0, 1), params=problem.params, **same),
        integrate(problem, (0.5, 1), **same),
        IntegrationResult(integrate(problem, (0, 1), **same)),
    ):
        assert [group["title"] for group in of(run)["errors"]] == ["Errors of the invariants"]
    run = integrate(oscillator, (0, 1), Y0, **same)
    assert of(run)["errors"] == []
    finer = integrate(oscillator, (0, 1), Y0, method=EIPDOP853, rtol=1e-10, atol=1e-10, t_eval=run.t)
    for reference in (finer, finer.y, lambda t: finer.y[:, np.flatnonzero(run.t == t)[0]]):
        (group,) = of(run, reference=reference)["errors"]
        np.testing.assert_allclose(group["rows"][0], np.abs(run.y - finer.y).max(axis=0), rtol=1e-2)
    with pytest.raises(ValueError, match="the times of the reference and of the run differ"):
        of(run, reference=integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.05, save_every=1))
    with pytest.raises(ValueError, match=r"has the shape \(2,\); expected \(2, 11\)"):
        of(run, reference=Y0)


def test_states_of_other_kinds():
    plane = of(integrate(harmonic(), (0, 1), method=EIPRK4, h=0.1, save_every=1))["state"]
    assert (plane["kind"], plane["names"], plane["equal"]) == ("orbits", ["p over q"], False)
    top = equations({"a": "b*c", "b": "-2*c*a", "c": "a*b"})
    curves = of(integrate(top, (0, 1), [1, 0.3, 0.2], method=EIPRK4, h=0.1, save_every=1))["state"]
    assert (curves["kind"], curves["names"], len(curves["rows"])) == ("curves", ["a", "b", "c"], 3)
    scene = soliton(points=80, t_end=0.1)
    run = integrate(scene, h=0.02, save_every=1)
    profile = of(run)["state"]
    assert profile["kind"] == "profile"
    np.testing.assert_allclose(profile["rows"], np.abs(run.y.T), rtol=1e-3)
    sol = solve_ivp(oscillator, (0, 1), Y0)
    assert of(sol, names="x y")["state"]["names"] == ["orbit"]
    with pytest.raises(ValueError, match=r"1 saved states, expected two or more; use save_every"):
        of(integrate(oscillator, (0, 0), Y0, method=EIPRK4, h=0.1))


def test_long_runs_are_thinned_and_peaks_stay(monkeypatch):
    monkeypatch.setattr(module, "FRAMES", 50)
    run = circling()
    run.invariants[0, 123] += 1.0
    found = of(run)
    assert len(found["t"]) == 50
    assert [found["t"][0], found["t"][-1]] == pytest.approx([0.0, 20.0])
    assert max(found["errors"][0]["rows"][0]) == pytest.approx(1.0)


class Addresses(HTMLParser):
    """Addresses of all resources that a page could load."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "href", "action", "data")]


def test_the_page_loads_nothing_and_runs_no_names():
    run = circling()
    run.message = "</script><script>alert(1)</script>"
    text = module.page(run, names=["x</script>", "y<img src=x>", "vx", "vy"])
    assert content(text)["message"] == run.message
    assert text.count("</script>") == 2
    assert "default-src 'none'" in text
    page = Addresses()
    page.feed(text)
    assert page.found == []
    assert not re.search(r"https?:|@import|url\(", text)


def test_untrusted_runs_say_so():
    run = circling()
    run.trusted = False
    assert of(run)["doubt"] == "Not to be trusted."
    assert of(run)["title"].endswith("not to be trusted")


def test_without_a_path_the_browser_opens_it(monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr(module.webbrowser, "open", opened.append)
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    path = view(circling())
    assert opened == [path.as_uri()]
    assert path.parent == tmp_path


def test_command(tmp_path, capsys):
    run = circling()
    run.save(tmp_path / "kepler.npz")
    finer = circling(h=0.01, save_every=None, t_eval=run.t)
    finer.save(tmp_path / "finer.npz")
    arguments = ["view", str(tmp_path / "kepler.npz"), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--reference", str(tmp_path / "finer.npz")]) == 0
    path = tmp_path / "out" / "kepler.html"
    out = capsys.readouterr().out
    assert "EIPRK4, h = 0.03; 335 saved states from t = 0 to 20" in out
    assert str(path) in out
    found = content(path.read_text(encoding="utf-8"))
    assert [group["title"] for group in found["errors"]] == ["Errors of the invariants", "Errors of the trajectory"]
    (tmp_path / "other.npz").write_bytes(b"PK")
    for name in ("absent.npz", "other.npz"):
        assert main(["view", str(tmp_path / name), "--out", str(tmp_path)]) == 2
        assert f"cannot read '{tmp_path / name}'" in capsys.readouterr().err
    assert main([*arguments, "--names", "x y"]) == 2
    assert "2 names for 4 components" in capsys.readouterr().err
    assert load(tmp_path / "kepler.npz").success


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
@pytest.mark.parametrize("size", ["1100,760", "400,1100"])
def test_in_a_browser(size, tmp_path):
    """Half of the way, by the address: the time, the errors there, and something drawn in each panel."""
    run = circling()
    path = run.view(tmp_path / "kepler.html")
    place = f"{path.as_uri()}#0.5"
    options = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]

    def browse(*what):
        return subprocess.run([*options, *what, place], capture_output=True, text=True, timeout=60, check=True).stdout

    shown = browse("--dump-dom")
    middle = (run.t.size - 1) // 2 + (run.t.size - 1) % 2
    assert f"t = {run.t[middle]:.4g}</output>" in shown
    assert shown.count("<canvas") == 3
    assert re.search(r"H: \S+</span>", shown)
    browse("--hide-scrollbars", f"--window-size={size}", f"--screenshot={tmp_path / 'page.png'}")
    picture = image.imread(tmp_path / "page.png")[..., :3]
    blue = np.abs(picture - np.array([0, 0x72, 0xB2]) / 255).max(axis=-1) < 0.02
    width = int(size.split(",")[0])
    assert picture.shape[1] == width
    assert blue.sum() > 300
    assert (np.flatnonzero(blue.any(axis=0)) < 0.95 * width).any()
