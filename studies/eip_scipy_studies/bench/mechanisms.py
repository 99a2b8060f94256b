"""Mechanisms of the bench, with known motions: from functions of arrays, and from models of SymPy.

Sources: the multibody benchmark library of IFToMM (A02 N-four-bar, A04 Bricard), the test set for initial value problem
solvers (Andrews' squeezing mechanism, car axis).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy.problems import MechanicsProblem, mechanics, mechanism

from ..report import needed

njit = needed("numba", '"eip_scipy[numba]"').njit

G = 9.81  # m/s^2
FINEST = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}


# The N-four-bar mechanism: N windows of rods of 1 m and 1 kg. The cranks are fixed at (i, 0), their ends are B_i.


def n_four_bar(n: int, t_end: float = 10.0, **options: Any) -> MechanicsProblem:
    """Return the N-four-bar mechanism of `n` windows, in the coordinates of the ends of its cranks.

    A window consists of two cranks and the coupler between their ends; neighbouring windows share a crank. All cranks
    start upright, and their ends move at 1 m/s. The `options` are passed to `mechanism`.
    """
    ends = n + 1
    M, weights = np.eye(ends) / 3, np.full(ends, 0.5)
    for i in range(n):
        M[i : i + 2, i : i + 2] += np.array([[2, 1], [1, 2]]) / 6
        weights[i : i + 2] += 0.5
    q0, u0, forces = (np.zeros(2 * ends) for _ in range(3))
    q0[0::2], q0[1::2], u0[0::2], forces[1::2] = np.arange(ends), 1.0, 1.0, -G * weights

    @njit
    def lengths(t: Any, q: Any) -> np.ndarray:
        out = np.empty(2 * ends - 1)
        for i in range(ends):
            out[i] = ((q[2 * i] - i) ** 2 + q[2 * i + 1] ** 2 - 1) / 2
        for i in range(ends - 1):
            out[ends + i] = ((q[2 * i + 2] - q[2 * i]) ** 2 + (q[2 * i + 3] - q[2 * i + 1]) ** 2 - 1) / 2
        return out

    @njit
    def gamma(t: Any, q: Any, u: Any) -> np.ndarray:  # exact, which matters next to singular positions
        out = np.empty(2 * ends - 1)
        for i in range(ends):
            out[i] = u[2 * i] ** 2 + u[2 * i + 1] ** 2
        for i in range(ends - 1):
            out[ends + i] = (u[2 * i + 2] - u[2 * i]) ** 2 + (u[2 * i + 3] - u[2 * i + 1]) ** 2
        return out

    @njit
    def height(t: Any, q: Any) -> Any:
        total = 0.0
        for i in range(ends):
            total += G * weights[i] * q[2 * i + 1]
        return total

    def reference(t: float) -> np.ndarray:
        angle, rate = _crank(n, t)
        x = np.ravel([np.arange(ends) + np.sin(angle), np.full(ends, np.cos(angle))], order="F")
        return np.append(x, np.tile([np.cos(angle) * rate, -np.sin(angle) * rate], ends))

    return mechanism(
        np.kron(M, np.eye(2)),
        forces,
        lengths,
        q0=q0,
        u0=u0,
        t_span=(0.0, t_end),
        potential_energy=height,
        gamma=gamma,
        name=f"{n}-four-bar",
        reference=reference,
        source="multibody benchmark library, A02",
        **options,
    )


def _crank(n: int, t: float) -> np.ndarray:
    """Return the angle [rad] from the vertical at time `t`, which is the same for all cranks, and its rate."""
    factor = G * ((n + 1) / 2 + n) / ((n + 1) / 3 + n)
    return solve_ivp(lambda t, y: [y[1], factor * np.sin(y[0])], (0, t), [0.0, 1.0], **FINEST).y[:, -1]


# Andrews' squeezing mechanism: seven angles, six constraints, a driving torque, a spring.

START = [
    -0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449, 0.222668390165885884674473185609,
    0.487364979543842550225598953530, -0.222668390165885884674473185609, 1.23054744454982119249735015568,
]  # fmt: skip
END = [
    15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304,
    0.5347301163226948, 1.048080741042263,
]  # fmt: skip
M1, M2, M3, M4, M5, M6, M7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
I1, I2, I3, I4, I5, I6, I7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
XA, YA, XB, YB, XC, YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
D, DA, E, EA, RR, RA, SS, SA, SB, SC, SD = (
    0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092, 0.035, 0.01874, 0.01043, 0.018, 0.02
)  # fmt: skip
TA, TB, U, UA, UB, ZF, ZT, FA = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
TORQUE, STIFFNESS, LENGTH = 0.033, 4530.0, 0.07785


def andrews() -> MechanicsProblem:
    """Return Andrews' squeezing mechanism."""
    return mechanism(
        _andrews_mass,
        _andrews_forces,
        _andrews_constraints,
        q0=START,
        u0=np.zeros(7),
        t_span=(0.0, 0.03),
        potential_energy=njit(lambda t, q: STIFFNESS / 2 * (_spring(q)[0] - LENGTH) ** 2 - TORQUE * q[0]),
        coordinates="beta Theta gamma Phi delta Omega epsilon",
        name="andrews",
        source="test set for initial value problem solvers",
        reference=lambda t: np.array(END) if t == 0.03 else None,
    )


@njit
def _andrews_mass(q: Any) -> np.ndarray:
    e, f = E - EA, ZF - FA
    M = np.zeros((7, 7))
    M[0, 0] = M1 * RA**2 + M2 * (RR**2 - 2 * DA * RR * np.cos(q[1]) + DA**2) + I1 + I2
    M[1, 0] = M[0, 1] = M2 * (DA**2 - DA * RR * np.cos(q[1])) + I2
    M[1, 1] = M2 * DA**2 + I2
    M[2, 2] = M3 * (SA**2 + SB**2) + I3
    M[3, 3] = M4 * e**2 + I4
    M[3, 4] = M[4, 3] = M4 * (e**2 + ZT * e * np.sin(q[3])) + I4
    M[4, 4] = M4 * (ZT**2 + 2 * ZT * e * np.sin(q[3]) + e**2) + M5 * (TA**2 + TB**2) + I4 + I5
    M[5, 5] = M6 * f**2 + I6
    M[5, 6] = M[6, 5] = M6 * (f**2 - U * f * np.sin(q[5])) + I6
    M[6, 6] = M6 * (f**2 - 2 * U * f * np.sin(q[5]) + U**2) + M7 * (UA**2 + UB**2) + I6 + I7
    return M


@njit
def _spring(q: Any) -> tuple[Any, Any, Any]:
    """Return the spring's length, and the components x and y of the vector along it."""
    x = SD * np.cos(q[2]) + SC * np.sin(q[2]) + XB - XC
    y = SD * np.sin(q[2]) - SC * np.cos(q[2]) + YB - YC
    return np.sqrt(x**2 + y**2), x, y


@njit
def _andrews_forces(t: Any, q: Any, u: Any) -> np.ndarray:
    e, f = E - EA, ZF - FA
    length, x, y = _spring(q)
    pull = -STIFFNESS * (length - LENGTH) / length
    return np.array(
        [
            TORQUE - M2 * DA * RR * u[1] * (u[1] + 2 * u[0]) * np.sin(q[1]),
            M2 * DA * RR * u[0] ** 2 * np.sin(q[1]),
            pull * (x * (SC * np.cos(q[2]) - SD * np.sin(q[2])) + y * (SD * np.cos(q[2]) + SC * np.sin(q[2]))),
            M4 * ZT * e * u[4] ** 2 * np.cos(q[3]),
            -M4 * ZT * e * u[3] * (u[3] + 2 * u[4]) * np.cos(q[3]),
            -M6 * U * f * u[6] ** 2 * np.cos(q[5]),
            M6 * U * f * u[5] * (u[5] + 2 * u[6]) * np.cos(q[5]),
        ]
    )


@njit
def _andrews_constraints(t: Any, q: Any) -> np.ndarray:
    x = RR * np.cos(q[0]) - D * np.cos(q[0] + q[1])
    y = RR * np.sin(q[0]) - D * np.sin(q[0] + q[1])
    return np.array(
        [
            x - SS * np.sin(q[2]) - XB,
            y + SS * np.cos(q[2]) - YB,
            x - E * np.sin(q[3] + q[4]) - ZT * np.cos(q[4]) - XA,
            y + E * np.cos(q[3] + q[4]) - ZT * np.sin(q[4]) - YA,
            x - ZF * np.cos(q[5] + q[6]) - U * np.sin(q[6]) - XA,
            y - ZF * np.sin(q[5] + q[6]) + U * np.cos(q[6]) - YA,
        ]
    )


# The car axis: on two springs on two wheels, the left wheel at rest, the right one on a bumpy road.

CAR_END = [
    0.04934557842755629, 0.4969894602303324, 1.041742524885400, 0.3739110272652214, -0.07705836840321485,
    0.007446866596327776, 0.01755681574942899, 0.7703410437794031,
]  # fmt: skip
CAR_MASS, REST_LENGTH, BUMP, BUMPS = 5e-4, 0.5, 0.1, 10.0  # of an end of the axis; of the springs; of the road


def car_axis() -> MechanicsProblem:
    """Return the car axis, in the coordinates of its ends, with constraints that depend on t."""
    return mechanism(
        np.full(4, CAR_MASS),
        _car_forces,
        _car_constraints,
        q0=[0, REST_LENGTH, 1, REST_LENGTH],
        u0=[-0.5, 0, -0.5, 0],
        t_span=(0.0, 3.0),
        coordinates="x_l y_l x_r y_r",
        name="car axis",
        source="test set for initial value problem solvers",
        reference=lambda t: np.array(CAR_END) if t == 3.0 else None,
    )


@njit
def _right_wheel(t: Any) -> np.ndarray:
    """Return the position of the right wheel, at a distance of 1 from the left one."""
    height = BUMP * np.sin(BUMPS * t)
    return np.array([np.sqrt(1 - height**2), height])


@njit
def _car_forces(t: Any, q: Any, u: Any) -> np.ndarray:
    out, right = np.empty(4), q[2:] - _right_wheel(t)
    for k in range(2):
        x, y = (q[0], q[1]) if k == 0 else (right[0], right[1])
        length = np.sqrt(x * x + y * y)
        out[2 * k] = (REST_LENGTH - length) / length * x
        out[2 * k + 1] = (REST_LENGTH - length) / length * y - CAR_MASS
    return out


@njit
def _car_constraints(t: Any, q: Any) -> np.ndarray:
    """Return the residuals of the constraints.

    The left spring is perpendicular to the line between the wheels, and the axis has the length 1.
    """
    axis = q[:2] - q[2:]
    return np.array([q[:2] @ _right_wheel(t), axis @ axis - 1])


# Bricard's mechanism: a loop of six rods of 1 m, the first one the ground. The axis of each joint is perpendicular to
# both of its rods, and those of the two joints of a rod are perpendicular to each other. At the start all axes are
# parallel to those of the coordinates.

CORNERS = np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1]], float)
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)


def bricard(section: float = 0.1, axes: bool = True, t_end: float = 10.0, **options: Any) -> MechanicsProblem:
    """Return Bricard's mechanism of five rods of 1 kg with a square section of side `section` [m], gravity along -y.

    Its coordinates are those of the corners P2 to P5 and, if `axes` is true, of the axes of the joints there: 24
    constraints of rank 23. Otherwise the axes follow from the rods, which are then slender: 12 constraints of rank 11.
    The `options` are passed to `mechanism`.
    """
    whole, weights = np.zeros((6, 6)), np.zeros(6)
    for i, j in ((k, (k + 1) % 6) for k in range(1, 6)):
        whole[np.ix_([i, j], [i, j])] += np.array([[2, 1], [1, 2]]) / 6
        weights[[i, j]] += 0.5

    @njit
    def rods(q: Any) -> Any:
        r = np.empty((6, 3))
        for j in range(3):
            for k in range(6):
                first = CORNERS[k, j] if k < 2 else q[3 * k - 6 + j]
                last = CORNERS[(k + 1) % 6, j] if (k + 1) % 6 < 2 else q[3 * (k + 1) - 6 + j]
                r[k, j] = last - first
        return r

    @njit
    def with_axes(t: Any, q: Any) -> np.ndarray:
        r, a, out = rods(q), np.empty((7, 3)), np.empty(24)
        for j in range(3):
            for k in range(7):
                a[k, j] = AXES[k % 6, j] if k % 6 < 2 else q[6 + 3 * k + j]
        for k in range(4):
            out[k] = a[k + 2] @ a[k + 2] - 1
        for k in range(1, 6):
            out[4 * k] = r[k] @ r[k] - 1
            out[4 * k + 1], out[4 * k + 2], out[4 * k + 3] = a[k] @ r[k], a[k + 1] @ r[k], a[k] @ a[k + 1]
        return out

    @njit
    def without(t: Any, q: Any) -> np.ndarray:
        r, out = rods(q), np.empty(12)
        a2, a5 = np.cross(r[1], AXES[1]), np.cross(r[5], AXES[0])
        a3, a4 = np.cross(r[2], a2), np.cross(r[4], a5)
        for k in range(5):
            out[k] = r[k + 1] @ r[k + 1] - 1
        out[5], out[6], out[7], out[8] = r[1] @ AXES[1], r[2] @ a2, r[3] @ a3, r[3] @ a4
        out[9], out[10], out[11] = r[4] @ a5, r[5] @ AXES[0], a3 @ a4
        return out

    @njit
    def height(t: Any, q: Any) -> Any:
        return G * (weights[2] * q[1] + weights[3] * q[4] + weights[4] * q[7] + weights[5] * q[10])

    M, forces = np.kron(whole[2:, 2:], np.eye(3)), -G * np.kron(weights[2:], [0, 1, 0])
    q0 = CORNERS[2:].ravel()
    if axes:
        # The second moments of two rods along each axis.
        M, forces, q0 = np.pad(M, (0, 12)), np.pad(forces, (0, 12)), np.append(q0, AXES[2:].ravel())
        M[12:, 12:] = np.eye(12) * 2 * section**2 / 12
    return mechanism(
        M,
        forces,
        with_axes if axes else without,
        q0=q0,
        u0=np.zeros(q0.size),
        t_span=(0.0, t_end),
        potential_energy=height,
        name="bricard",
        source="multibody benchmark library, A04",
        **options,
    )


# A skate on a slope: its blade does not slip sideways.


def knife_edge(t_end: float = 10.0) -> MechanicsProblem:
    """Return a knife edge that turns at the rate 1 on a slope, along which the acceleration is 1 in the direction x."""

    def reference(t: float) -> np.ndarray:
        x, y = np.sin(t) ** 2 / 2, (t - np.sin(2 * t) / 2) / 2
        return np.array([x, y, t, np.sin(t) * np.cos(t), np.sin(t) ** 2, 1.0])

    return mechanism(
        [1, 1, 1],
        [1, 0, 0],
        velocity_constraints=njit(lambda t, q, u: np.array([np.sin(q[2]) * u[0] - np.cos(q[2]) * u[1]])),
        q0=[0, 0, 0],
        u0=[0, 0, 1],
        t_span=(0.0, t_end),
        potential_energy=njit(lambda t, q: -q[0]),
        coordinates="x y angle",
        name="knife edge",
        reference=reference,
    )


# Models of SymPy.


@cache
def four_bar_model() -> tuple[Any, dict[Any, float]]:
    """Return a four-bar linkage with particles at the ends of its links as a KanesMethod, and the constants' values."""
    import sympy
    import sympy.physics.mechanics as me

    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    la, lb, lc, ln, m, g = sympy.symbols("la lb lc ln m g")
    N = me.ReferenceFrame("N")
    frames, points, frame = [], [me.Point("P1")], N
    points[0].set_vel(N, 0)
    for k, length in enumerate((la, lb, lc)):
        before, frame = frame, me.ReferenceFrame("ABC"[k])
        frame.orient_axis(before, q[k], N.z)
        frame.set_ang_vel(before, u[k] * N.z)
        points.append(points[-1].locatenew(f"P{k + 2}", length * frame.x))
        points[-1].v2pt_theory(points[-2], N, frame)
        frames.append(frame)
    loop = points[3].pos_from(points[0]) - ln * N.x
    closed = [loop.dot(N.x), loop.dot(N.y)]
    speeds = {a.diff(): b for a, b in zip(q, u, strict=True)}
    kane = me.KanesMethod(
        N,
        q[:1],
        u[:1],
        kd_eqs=[a - b for a, b in speeds.items()],
        q_dependent=q[1:],
        u_dependent=u[1:],
        configuration_constraints=closed,
        velocity_constraints=[item.diff(me.dynamicsymbols._t).xreplace(speeds) for item in closed],
    )
    loads = [(point, -m * g * N.y) for point in points[1:]]
    kane.kanes_equations([me.Particle(f"p{k}", point, m) for k, point in enumerate(points[1:])], loads)
    return kane, {la: 0.8, lb: 2.0, lc: 1.0, ln: 2.0, m: 1.0, g: G}


def with_baumgarte(problem: MechanicsProblem, factor: float) -> Callable[[float, Any], Any]:
    """Return the right-hand side of the four-bar linkage as users write it: lambdify and numpy.linalg.solve.

    Baumgarte's terms, -2 `factor` g' - `factor`^2 g for the constraints g = 0, are added to the constraints on the
    accelerations.
    """
    matrices = four_bar_matrices(factor)

    def fun(t: float, y: Any) -> Any:
        M, forces = matrices(y)
        return np.append(y[3:], np.linalg.solve(M, forces.ravel()))

    return fun


def four_bar_matrices(factor: float) -> Callable[[Any], Any]:
    """Return the function of a state that returns the matrix and the right-hand side of the linkage's accelerations."""
    import sympy

    model, constants = four_bar_model()
    state = [*model.q, *model.u]
    rates = model._k_nh * sympy.Matrix(model.u) + model._f_nh
    rows = sympy.zeros(1, 1).col_join(-2 * factor * rates - factor**2 * model._f_h)
    plain = [sympy.Dummy() for _ in state]
    known = {sympy.Symbol(k.name): v for k, v in constants.items()} | dict(zip(state, plain, strict=True))
    return sympy.lambdify(
        [plain], [item.xreplace(known) for item in (model.mass_matrix, model.forcing + rows)], cse=True
    )


def four_bar(t_end: float = 30.0) -> MechanicsProblem:
    """Return the four-bar linkage, at rest with its first link at 10 degrees."""
    model, constants = four_bar_model()
    start = {"q1": np.radians(10), "q2": 0.1, "q3": -2.6}
    return mechanics(model, constants, start, [0, 0, 0], t_span=(0.0, t_end), name="four-bar")


@cache
def _disc_model() -> tuple[Any, dict[Any, float]]:
    """Return a thin disc that rolls on a plane as a KanesMethod, and the constants' values."""
    import sympy
    import sympy.physics.mechanics as me

    yaw, lean, spin, x, y, z = q = me.dynamicsymbols("yaw lean spin x y z")
    u = me.dynamicsymbols("u1:7")
    m, g, r = sympy.symbols("m g r")
    N, Y, L, R = (me.ReferenceFrame(name) for name in "NYLR")
    Y.orient_axis(N, yaw, N.z)
    L.orient_axis(Y, lean, Y.x)
    R.orient_axis(L, spin, L.y)
    w = R.ang_vel_in(N)
    rates = [w.dot(axis) for axis in (L.x, L.y, L.z)]
    kinematics = [a - b for a, b in zip((*rates, x.diff(), y.diff(), z.diff()), u, strict=True)]
    solved = sympy.solve(kinematics, [item.diff() for item in q])
    R.set_ang_vel(N, u[0] * L.x + u[1] * L.y + u[2] * L.z)
    origin = me.Point("O")
    origin.set_vel(N, 0)
    centre = origin.locatenew("C", x * N.x + y * N.y + z * N.z)
    centre.set_vel(N, u[3] * N.x + u[4] * N.y + u[5] * N.z)
    contact = centre.vel(N) + R.ang_vel_in(N).cross(-r * L.z)
    inertia = me.inertia(L, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4)
    height = z - r * sympy.cos(lean)
    kane = me.KanesMethod(
        N,
        [yaw, lean, spin, x, y],
        u[:3],
        kd_eqs=[a - b for a, b in solved.items()],
        q_dependent=[z],
        u_dependent=u[3:],
        configuration_constraints=[height],
        velocity_constraints=[contact.dot(axis) for axis in N],
    )
    kane.kanes_equations([me.RigidBody("D", centre, R, m, (inertia, centre))], [(centre, -m * g * N.z)])
    return kane, {m: 1.0, g: G, r: 1.0}


def disc(wobbling: bool, t_end: float = 5.0) -> MechanicsProblem:
    """Return a rolling disc that leans by 0.3 rad: wobbling, or else in steady motion on a circle."""
    lean, turning = 0.3, 1.0
    spinning = (turning**2 * np.tan(lean) - 4 * G * np.sin(lean)) / (6 * turning)  # of steady motion
    if wobbling:
        spinning *= 1.3
    model, constants = _disc_model()
    return mechanics(
        model,
        constants,
        {"lean": lean, "yaw": 0, "spin": 0, "x": 0, "y": 0},
        {"u1": 0, "u2": spinning, "u3": turning},
        t_span=(0.0, t_end),
        name="wobbling disc" if wobbling else "steady disc",
        reference=lambda t: _rolled(np.array([0, lean, 0, 0, 0, 0, spinning, turning]), t),
    )


def _rolled(start: np.ndarray, t: float) -> np.ndarray:
    """Return the state at time `t` of a thin rolling disc of radius 1, from equations that need no constraints.

    `start` is (yaw, lean, spin, x, y, u1, u2, u3) with the angular velocity u1 to u3; the result has z after y, and the
    velocity of the centre at the end.
    """

    def fun(t: float, s: np.ndarray) -> list[float]:
        yaw, lean, _, _, _, u1, u2, u3 = s
        tan = np.tan(lean)
        turning, rolled = u3 / np.cos(lean), u2
        vx, vy, _ = _centre_velocity(yaw, lean, u1, u2)
        return [
            turning, u1, u2 - u3 * tan, vx, vy,
            (4 * G * np.sin(lean) + 6 * rolled * u3 - u3**2 * tan) / 5, -2 * u1 * u3 / 3, (-2 * u2 + u3 * tan) * u1,
        ]  # fmt: skip

    yaw, lean, spin, x, y, u1, u2, u3 = solve_ivp(fun, (0, t), start, **FINEST).y[:, -1] if t > 0 else start
    return np.array([yaw, lean, spin, x, y, np.cos(lean), u1, u2, u3, *_centre_velocity(yaw, lean, u1, u2)])


def _centre_velocity(yaw: float, lean: float, u1: float, u2: float) -> tuple[float, float, float]:
    """Return the velocity u2 L.x - u1 L.y of the centre of a rolling disc of radius 1, in the frame at rest.

    L.x and L.y are unit vectors of a frame that takes part in yaw and lean but not in the spin, and `u1` and `u2` are
    the components of the angular velocity along them.
    """
    return (
        u2 * np.cos(yaw) + u1 * np.sin(yaw) * np.cos(lean),
        u2 * np.sin(yaw) - u1 * np.cos(yaw) * np.cos(lean),
        -u1 * np.sin(lean),
    )


EXAMPLES: dict[str, Callable[[], MechanicsProblem]] = {
    "four-bar": four_bar,
    "1-four-bar": lambda: n_four_bar(1),
    "5-four-bar": lambda: n_four_bar(5),
    "20-four-bar": lambda: n_four_bar(20),
    "andrews": andrews,
    "car axis": car_axis,
    "bricard": bricard,
    "wobbling disc": lambda: disc(True),
    "steady disc": lambda: disc(False),
    "knife edge": knife_edge,
}
