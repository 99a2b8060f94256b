"""REBOUND's simulations and archives as problems and runs, and back."""

import pickle
import re
import warnings

import numpy as np
import pytest
from systems import refuse

rebound = pytest.importorskip("rebound")

from eip_scipy import EIPDOP853, EIPRKN12, ensemble, integrate, load  # noqa: E402
from eip_scipy.integrations import rebound as exchange  # noqa: E402
from eip_scipy.problems import ForceConstants, kepler, nbody, orbital_elements, solar_system  # noqa: E402

VERSION_5 = hasattr(rebound.Particle, "name")
UNITS = {  # masses and lengths in them, and the problem's
    None: (1.0, 1.0, "as in the REBOUND simulation"),
    ("yr", "AU", "Msun"): (1.0, 1.0, "AU, yr"),
    ("yr2pi", "AU", "Msun"): (1.0, 1.0, r"AU, 5022642\.89\d* s"),
    ("d", "km", "Mjupiter"): (1047.0, 1.5e8, "km, d"),
    ("sidereal_yr", "pc", "kg"): (2e30, 5e-6, r"3\.0856775\d*e\+16 m, 31558149\.76\d* s"),
}


def planets(units=None, *, test_mass=0.0):
    """Return a star, two planets of which one has no name, and a test particle."""
    sim = rebound.Simulation()
    if units:
        sim.units = units
    mass, length, _ = UNITS[units]
    label = "name" if VERSION_5 else "hash"
    sim.add(m=mass, **{label: "star"})
    sim.add(m=1e-3 * mass, a=length, e=0.1, **{label: "b"})
    sim.add(m=1e-4 * mass, a=2 * length)
    sim.add(m=test_mass, a=5 * length, inc=0.1, **{label: "dust"})
    sim.N_active = 3
    sim.testparticle_hidewarnings = 1
    sim.move_to_com()
    sim.dt = 0.01 * sim.particles[1].P
    return sim


def state(sim):
    return np.ravel([[p.xyz for p in sim.particles], [p.vxyz for p in sim.particles]])


def short_run(**options):
    problem = exchange.problem_from_simulation(planets())
    return integrate(problem, (0, 3), method=EIPRKN12, **{"save_every": 20, **options})


def test_distances_that_end_a_simulation_are_events():
    """A planet on a radial way out crosses 3; two bodies that fall together meet at 0.5: both to rounding."""
    sim = rebound.Simulation()
    sim.add(m=1.0)
    sim.add(m=0.0, x=1.0, vx=2.0)
    sim.N_active, sim.exit_max_distance, sim.dt = 1, 3.0, 0.01
    problem = exchange.problem_from_simulation(sim, t_span=(0, 10))
    run = integrate(problem, method=EIPDOP853, rtol=1e-10)
    assert run.status == 1
    assert run.y[3, -1] == pytest.approx(3.0, rel=1e-12)
    members = ensemble(problem, problem.t_span, problem.y0[None], method=EIPDOP853, rtol=1e-10)
    assert np.array_equal(members.y[0], run.y[:, -1])
    assert np.array_equal(problem.solve_ivp(method=EIPDOP853, rtol=1e-10).t_events, run.t_events)
    assert integrate(problem, method=EIPDOP853, rtol=1e-10, events=()).status == 0
    sim = rebound.Simulation()
    for side in (-1, 1):
        sim.add(m=0.5, x=side, vy=0.1 * side)
    sim.exit_min_distance, sim.dt = 0.5, 0.01
    problem = exchange.problem_from_simulation(sim, t_span=(0, 10))
    run = integrate(problem, method=EIPDOP853, rtol=1e-10)
    assert np.linalg.norm(run.y[3:6, -1] - run.y[:3, -1]) == pytest.approx(0.5, rel=1e-12)


@pytest.mark.needs_jit
def test_distances_are_compiled_and_count_at_the_start():
    sim = planets()  # the dust is at 5
    sim.exit_max_distance, sim.exit_min_distance = 4.0, 1e-3
    run = integrate(pickle.loads(pickle.dumps(exchange.problem_from_simulation(sim))), method=EIPRKN12)
    assert (run.t[-1], run.message) == (0.0, "A termination event occurred.")


def test_a_heartbeat_is_named():
    sim = planets()
    assert exchange.exit_events(sim) == []
    sim.heartbeat = lambda simulation: None
    with pytest.warns(UserWarning, match="heartbeat is not called by runs of the problem"):
        exchange.problem_from_simulation(sim)


@pytest.mark.parametrize("units", UNITS)
def test_there_and_back(units):
    sim = planets(units)
    problem = exchange.problem_from_simulation(sim)
    assert re.fullmatch(UNITS[units][2], problem.units)
    assert problem.G == sim.G
    back = exchange.to_simulation(problem)
    np.testing.assert_array_equal(state(back), state(sim))
    assert (back.G, back.t, back.N_active) == (sim.G, sim.t, 3)
    assert exchange.problem_from_simulation(back).units == problem.units  # "d" and "day" are one unit
    assert back.units["mass"] == sim.units["mass"]
    np.testing.assert_allclose([p.m for p in back.particles], [p.m for p in sim.particles], rtol=4e-16)
    if VERSION_5:
        assert [p.name for p in back.particles] == ["star", "b", None, "dust"]
        assert problem.component_names[:6] == ("x_star", "y_star", "z_star", "x_b", "y_b", "z_b")
        assert problem.component_names[6] == "x_2"


@pytest.mark.parametrize("kind", [0, 1])
def test_the_motion_is_that_of_rebound(kind):
    """A test particle of type 0 attracts nothing; a single one of type 1 is a body."""
    sim = planets(test_mass=1e-2)
    sim.testparticle_type = kind
    problem = exchange.problem_from_simulation(sim)
    run = integrate(problem, (0, 3), method=EIPRKN12, save_every=30)
    assert problem.params[3] == 1e-2 * kind
    sim.integrate(3.0)
    np.testing.assert_allclose(run.y[:, -1], state(sim), rtol=0, atol=1e-11)


def test_orbits_as_balances_against_ias15():
    """The orbits keep their energies at known rates, and the bodies come nearer to the positions of IAS15."""
    sim = planets(test_mass=0.0)
    problem = exchange.problem_from_simulation(sim, names=["star", "b", "c", "dust"], balances="kepler")
    names = [name for item in problem.invariants for name in item.value_names]
    assert names == ["energy of b", "energy of c", "energy of dust"]
    end, h = 100 * sim.particles[1].P, sim.particles[1].P / 20
    kept = integrate(problem, (0, end), method=EIPDOP853, h=h)
    plain = integrate(problem, (0, end), method=EIPDOP853, h=h, invariants=())
    sim.integrate(end)
    errors = [np.abs(run.y[:12, -1] - state(sim)[:12]).max() for run in (kept, plain)]
    assert kept.trusted
    assert errors[0] < 0.02 * errors[1], errors


def test_a_span_that_starts_elsewhere_than_the_state_is_refused():
    sim = planets()
    sim.t = 5.0
    with pytest.raises(ValueError, match=r"t_span starts at 0, but the state is that of t=5\. Give t_span=\(5, "):
        exchange.problem_from_simulation(sim, t_span=(0, 10))
    assert exchange.problem_from_simulation(sim, t_span=(5, 10)).t_span[0] == 5


def test_any_row_of_a_run():
    run = short_run()
    for k in (0, 2, -1):
        sim = exchange.to_simulation(run, row=k)
        assert sim.t == run.t[k]
        np.testing.assert_array_equal(state(sim), run.y[:, k])
    assert exchange.to_simulation(run, run.y[:, 2]).t == run.t[2]
    np.testing.assert_array_equal(state(exchange.to_simulation(run)), run.y[:, -1])
    assert exchange.to_simulation(run, 2 * run.y[:, 1], t=7.0).t == 7.0


def test_a_template_gives_all_but_state_and_time():
    template = planets(("yr", "AU", "Msun"), test_mass=1e-9)
    template.integrator = "whfast"
    template.particles[1].r = 1e-4
    problem = exchange.problem_from_simulation(template)
    run = integrate(problem, (0, 1), method=EIPRKN12)
    sim = exchange.to_simulation(run, template=template)
    assert (sim.dt, str(sim.integrator), sim.particles[1].r) == (template.dt, "whfast", 1e-4)
    assert [p.m for p in sim.particles] == [p.m for p in template.particles]
    assert (sim.t, template.t) == (1.0, 0.0)
    np.testing.assert_array_equal(state(sim), run.y[:, -1])


def test_archive(tmp_path):
    run = short_run()
    path = tmp_path / "run.bin"
    exchange.to_archive(run, path)
    archive = rebound.Simulationarchive(str(path))
    assert len(archive) == run.t.size
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        np.testing.assert_array_equal(state(archive[3]), run.y[:, 3])
    found = exchange.read_archive(path)
    np.testing.assert_array_equal(found.t, run.t)
    np.testing.assert_array_equal(found.y, run.y)
    if VERSION_5:
        assert found.component_names == run.component_names
    np.testing.assert_array_equal(orbital_elements(found).a, orbital_elements(run).a)
    every = exchange.read_archive(path, every=2, names=["A", "B", "C", "D"])
    np.testing.assert_array_equal(every.t, run.t[::2])
    assert every.component_names[0] == "x_A"
    with pytest.raises(FileExistsError, match="is there already"):
        exchange.to_archive(run, path)


def test_archives_that_are_none(tmp_path):
    (tmp_path / "text.bin").write_text("not an archive")
    sim = planets()
    for _ in range(2):
        sim.save_to_file(str(tmp_path / "sim.bin"))
        sim.particles[1].m *= 2
    rows = [
        ("none.bin", FileNotFoundError, "no file at"),
        ("text.bin", ValueError, "is not an archive of REBOUND"),
        ("sim.bin", ValueError, "masses in snapshot 1"),
    ]
    refuse(exchange.read_archive, [({"path": tmp_path / name}, *rest) for name, *rest in rows])


def test_bad_input_is_named():
    run = short_run()
    shape = r"y has the shape \(6,\); expected \(24,\) for 4 bodies"
    rows = [
        ({"run": kepler()}, TypeError, "expected a problem of bodies"),
        ({"row": 99}, ValueError, "no row 99, the run has"),
        ({"y": run.y[:, 0], "row": 0}, ValueError, "y or row, not both"),
        ({"y": run.y[:, 0] + 1}, ValueError, "not a saved state of the run. Give"),
        ({"y": run.y[:6, 0], "t": 0}, ValueError, shape),
        ({"run": solar_system(), "row": 0}, ValueError, "row selects a state of a run"),
        ({"run": solar_system(), "template": planets()}, ValueError, "template has other bodies"),
        ({"template": "archive.bin"}, TypeError, r"template must be a rebound\.Simulation"),
    ]

    refuse(lambda run=run, *, y=None, **options: exchange.to_simulation(run, y, **options), rows)
    with pytest.raises(ValueError, match="expected 4 names, all different"):
        exchange.problem_from_simulation(planets(), names=["A", "A", "C", "D"])
    with pytest.raises(TypeError, match="expected a run by integrate"):
        exchange.to_archive(solar_system(), "x.bin")
    with pytest.raises(ValueError, match="every must be an integer >= 1"):
        exchange.read_archive("x.bin", every=0)


def test_a_loaded_result_needs_its_problem(tmp_path):
    run = short_run()
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    with pytest.raises(TypeError, match="A result that was loaded"):
        exchange.to_simulation(again)
    problem = exchange.problem_from_simulation(planets())
    sim = exchange.to_simulation(problem, again.y[:, 1], t=again.t[1])
    np.testing.assert_array_equal(state(sim), run.y[:, 1])


def test_forces_may_be_named():
    sim = planets()
    sim.additional_forces = lambda pointer: None
    constants = ForceConstants(c=1e4)
    problem = exchange.problem_from_simulation(sim, forces="gr-potential", constants=constants)
    expected = nbody(
        [1.0, 1e-3, 1e-4, 0.0], *state(sim).reshape(2, 4, 3), t_span=(0, 1), forces="gr-potential", constants=constants
    )
    np.testing.assert_array_equal(problem.params, expected.params)
    assert exchange.problem_from_simulation(sim, forces=()).params.size == 4
    with pytest.raises(ValueError, match="constants= needs forces="):
        exchange.problem_from_simulation(planets(), constants=constants)
    with pytest.warns(UserWarning, match=r"also has gr-potential \(REBOUNDx: gr_potential\)"):
        exchange.to_simulation(problem)


def with_force(name):
    reboundx = pytest.importorskip("reboundx")
    sim = rebound.Simulation()
    sim.units = ("yr", "AU", "Msun")
    sim.add(m=1.0)
    sim.add(m=1e-7, a=0.38, e=0.2)
    sim.add(m=1e-3, a=5.2, e=0.05, inc=0.1)
    sim.move_to_com()
    extras = reboundx.Extras(sim)
    force = extras.load_force(name)
    extras.add_force(force)
    force.params["c"] = 63241.0
    return sim


@pytest.mark.parametrize(
    ("theirs", "ours"), [("gr", ["1pn"]), ("gr_full", ["eih"]), ("gr_potential", ["gr-potential"])]
)
def test_forces_of_reboundx(theirs, ours):
    sim = with_force(theirs)
    problem = exchange.problem_from_simulation(sim, t_span=(0, 5), h=2e-3)
    run = integrate(problem, method=EIPDOP853, h=2e-3)
    newton = integrate(nbody(problem.params[:3], *problem.y0.reshape(2, 3, 3), t_span=(0, 5)), method=EIPDOP853, h=2e-3)
    sim.integrate(5.0)
    error, effect = (np.abs(r.y[:, -1] - state(sim))[3:6].max() for r in (run, newton))
    assert error < 1e-3 * effect
    with pytest.warns(UserWarning, match=ours[0]):
        exchange.to_simulation(problem)
