"""Table of the runs: faulty ones, which must be reported, and correct ones, which must not; see `parsed`."""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy.problems import kepler, solar_system

from ..hard_cases import hard_cases
from .runs import Run, parsed

LATE = "leak that starts late, or acts in places"
LEAKS = "RK2 h=0.01, RK3 h=0.02, RK4 h=0.02, RK5 h=0.02 integrate, RK23 1e-5, RK45 1e-6, DOP853 1e-9 integrate"
STRENGTHS = "each=(0.1,0.01,0.001,0.0001)"
ONE = "(0,0,0,0,0.8,0,0,0,0,0,0,0,0,0,0,0)"
FALLING = "(1.0,3.0,-2.0,-1.0,1.0,-1.0,0,0,0,0,0,0) 1.5"
PLANETARY = f"((0,0,0),(5.2,0,0),(0.2,0,0)) ((0,0,0),(0,{5.2**-0.5},0),(0,{0.2**-0.5},0)) t_span=(0.0,200.0)"

FAULTY = f"""
= no invariant, its rate 0 at the start
pendulum with friction 0.2 | mechanics pendulum (2.0,0.0) strength=0.2 | RK45 1e-3, RK45 1e-4, RK45 1e-8, DOP853 1e-6,
    RK23 1e-5, RK5 1e-6, RK5 h=0.05, RK4 h=0.05, RK3 h=0.05, RK2 h=0.05, RK1 h=0.01, RK4 h=0.05 metric=euclidean,
    RK4 h=0.05 every=10, RK4 h=0.05 every=auto, RK4 h=0.05 direction=old, RK4 h=0.05 iterations=3,
    RK4 h=0.05 interpreted
pendulum with friction 0.2 | compiled_pendulum 0.2 | RK4 h=0.05, RK45 1e-6, RK4 h=0.05 compensated, RK2 h=0.05,
    RK1 h=0.01; integrate
pendulum with friction 0.2, Verlet's method | mechanics pendulum (2.0,0.0) strength=0.2 | VerletWithFriction h=0.02
pendulum with friction 0.2, an event ends it | mechanics pendulum (2.0,0.0) strength=0.2 | RK45 1e-8 events=turns_back,
    RK45 1e-8 events=turns_back interpreted
pendulum with friction 0.2, an event ends it | compiled_pendulum 0.2 | RK4 h=0.05 events=leaves integrate
pendulum, sign of the potential | mechanics pendulum (2.0,0.0) claim=('pendulum',-1.0) | RK45 1e-6, RK4 h=0.05
Duffing without its quartic term | mechanics duffing (0.5,0.0) claim=('duffing',0.0) | RK45 1e-6
Duffing, quartic term 5 % off | mechanics duffing (0.5,0.0) 5.0 claim=('duffing',1.05) | DOP853 1e-8
Henon-Heiles without its cubic terms | mechanics henon (0.3,0.2,0.0,0.0) 50.0 claim=('henon',0.0) | RK45 1e-6
driven spring | mechanics spring (1.0,0.3) push=sine strength=0.5 | RK45 1e-6, RK23 1e-4
driven spring | compiled_spring force=0.5 frequency=1.3 start=(1.0,0.3) | RK4 h=0.05, RKN12 h=0.1,
    RKN12 h=0.05 every=10 compensated, RKN8 h=0.05 every=auto; integrate
spring of changing stiffness | mechanics spring (1.0,0.0) push=stiffness strength=0.3 | RK45 1e-6, RKN12 h=0.3,
    RKN12 h=0.1 every=10, RKN8 1e-6
friction from t = 3 on | mechanics pendulum (2.0,0.0) push=friction_after_3 strength=0.3 | RK45 1e-6, RK4 h=0.02
friction on one side only | mechanics spring (0.0,1.5) push=friction_beyond strength=0.5 | RK45 1e-6
fall with drag 0.1 | mechanics stone (10.0,0.0) 10.0 push=drag strength=0.1 | RK45 1e-6, RK3 h=0.1
L in an anisotropic trap | mechanics trap (1.0,0.0,0.0,0.5) kept=('L',) | RK45 1e-6, RK4 h=0.05, RKN8 1e-6
L in an anisotropic trap | compiled_trap 2.0 | RK45 1e-6, RKN12 h=0.1, RK4 h=0.02; integrate
L of Henon-Heiles, started at x = 0 | mechanics henon (0.0,0.3,0.3,0.0) kept=('L',) | DOP853 1e-6
L of Henon-Heiles and its energy | mechanics henon (0.0,0.3,0.3,0.0) kept=('energy','L') | RK45 1e-6
L in a uniform field, started on its axis | mechanics kepler (1.0,0.0,0.0,1.1) kept=('L',) push=along_axis
    strength=0.02 | RK45 1e-6
Laplace's vector of a precessing orbit | mechanics kepler (0.5,0.0,0.0,1.7) kept=('A_x',) push=precession strength=0.01
    | RK45 1e-6, RK4 h=0.01
energy while the centre loses mass | mechanics kepler (0.5,0.0,0.0,1.7) push=mass_loss strength=1.0 | RK45 1e-7
springs with wrong masses | mechanics harmonic (1,0,0,0,0,0) masses=(1,2,3) | RK45 1e-6
Toda lattice, harmonic energy | mechanics toda {ONE} claim=('harmonic',1.0) | RK45 1e-6, RK4 h=0.05
FPUT chain, another alpha | mechanics fput ('mode',16) 50.0 0.25 claim=('fput',0.5) | RK45 1e-6
sine-Gordon, another coupling | mechanics sine_gordon ('kinks',32) 5.0 2.56 claim=('sine_gordon',2.304) | DOP853 1e-6
spin in a turning field, S_z | turning_field | RK45 1e-6
braked top | case rigid_body (1.0,2.0,3.0) (0.0,1.0,1.0) 20.0 push=brake | RK45 1e-6
particle in a field that is switched on | case boris_2d (0.01,) (1.0,0.0,0.1,0.3) 20.0 push=field kept=energy |
    RK4 h=0.02
particle, L without the field's part | case boris_2d (0.01,) (1.0,0.0,0.0,0.3) 3.0 kept=L | RK45 1e-5, RK4 h=0.02
three waves, a relation's sign | case three_wave () (1+0j,0.7,0.4) 10.0 kept=N | RK45 1e-6, RK4 h=0.02
Schroedinger, absorbing wall | waves 10.0 absorbing centre=3.0 width=1.0 keep=('mass',) | RK45 1e-6
Schroedinger, shaken trap | waves 5.0 shaken | RK45 1e-6, RK4 h=4e-3
Schroedinger, another trap's energy | waves 5.0 claim=other_trap | RK45 1e-6
condensate, half the interaction | waves 5.0 beta=5.0 claimed_beta=2.5 | DOP853 1e-6, RK4 h=4e-3 metric=euclidean
condensate, shaken, joint invariants | shaken_condensate | RK4 interpreted, RK45 1e-6
falling bodies, a wrong mass | case n_body ((3,4,5),1.0,2) {FALLING} ((3,4,5.5),1.0,2) kept=energy | RK45 1e-6
softened bodies, energy without softening | case n_body ((3,4,5),1.0,2,0.09) {FALLING} ((3,4,5),1.0,2) kept=energy |
    RK45 1e-6, RKN12 h=0.02 every=10
double pendulum, g = 9 for 9.81 | case double_pendulum (9.81,) (2.0,1.0,0.0,0.0) 5.0 (9.0,) | RK45 1e-6
top with another inertia | case rigid_body (1.0,2.0,3.0) (0.0,1.0,1.0) 20.0 (1.0,2.0,2.5) | RK45 1e-6
Lotka-Volterra, another coefficient | case lotka_volterra () (1.0,3.0) 15.0 kept=V | RK45 1e-6
geodesic with a wrong mass | case schwarzschild () (0.0,10.0,0.0,0.97,0.0,4.0) 300.0 kept=shell | RK45 1e-6
= no invariant, its rate seen at the start
pendulum with friction 0.2 | mechanics pendulum (2.0,1.0) strength=0.2 | RK45 1e-6, RK4 h=0.05
pendulum with friction 0.2 | compiled_pendulum 0.2 start=(2.0,1.0) | RK4 h=0.05 integrate
fall with drag 0.1 | mechanics stone (10.0,-1.0) 10.0 push=drag strength=0.1 | RK45 1e-6
Toda lattice, harmonic energy | mechanics toda (0,0,0,0,0.8,0,0,0,0,0,0,0,0.5,0,0,0) claim=('harmonic',1.0) |
    DOP853 1e-6
epidemic, another ratio | case sir (0.5,0.2) (0.9,0.1,0.0) 30.0 (0.5,0.25) | RK45 1e-6
attitude, another norm | case quaternion (1.0,) (1.0,0.2,0.3,0.0) 20.0 kept=norm | RK45 1e-6
spins, S_x across the axis | case heisenberg (0.5,) (0.6,0,0.8,0,0.6,0.8,-0.6,0,0.8,0,0.8,0.6) 10.0 kept=S_x | RK45 1e-6
condensate, half the interaction | waves 5.0 beta=5.0 claimed_beta=2.5 phase=2 | RK45 1e-6
= leak
pendulum with friction 0.01 | mechanics pendulum (2.0,0.0) strength=1e-2 | RK45 1e-4 atol=1e-4, RK45 1e-5, RK23 1e-4
pendulum with friction 0.001 | mechanics pendulum (2.0,0.0) strength=1e-3 | RK45 1e-6, RK45 1e-7, DOP853 1e-6,
    RK23 1e-6, RK5 1e-6, RK4 h=0.02, RK4 h=0.02 every=10
pendulum with friction 0.0001 | mechanics pendulum (2.0,0.0) strength=1e-4 | RK45 1e-8, DOP853 1e-8, RK4 h=0.02
pendulum with friction 1e-05 | mechanics pendulum (2.0,0.0) strength=1e-5 | RK45 1e-9, DOP853 1e-9
pendulum with friction 1e-06 | mechanics pendulum (2.0,0.0) strength=1e-6 | DOP853 1e-10
pendulum with friction 0.001 | compiled_pendulum 1e-3 50.0 | RK45 1e-6, DOP853 1e-8, RK4 h=0.02,
    RK4 h=0.02 compensated every=10; integrate
spring with friction 1e-5 | compiled_spring friction=1e-5 end=2000.0 | RK4 h=0.01 integrate
fall with drag 0.01 | mechanics stone (10.0,0.0) 10.0 push=drag strength=0.01 | RK45 1e-5
spring pushed by 1e-4 | compiled_spring force=1e-4 end=100.0 | RKN12 h=0.1, RKN12 h=0.1 every=10 compensated,
    RKN8 1e-8; integrate
satellite with drag 0.001 | mechanics kepler (1.0,0.0,0.0,1.2) 30.0 push=air strength=1e-3 | RK45 1e-6, DOP853 1e-8
satellite with drag 1e-5 | mechanics kepler (1.0,0.0,0.0,1.2) 30.0 push=air strength=1e-5 | DOP853 1e-9
post-Newtonian planets, Newton's energy | relativistic_planets | DOP853 1e-10, DOP853 h=0.01 integrate
Schroedinger, loss of 0.001 | waves 10.0 lossy centre=-3.0 width=1.0 keep=('mass',) | RK45 1e-6
sine-Gordon with friction 0.001 | mechanics sine_gordon ('kinks',64) 20.0 10.24 strength=1e-3 | RK45 1e-6
= {LATE}
friction from 5, % | mechanics pendulum (2.0,0.0) 30.0 push=friction_after_5 strength=% | {LEAKS} | {STRENGTHS}
drag at pericentre, % | mechanics kepler (1.6,0.0,0.0,0.5) 40.0 push=near_centre strength=% | {LEAKS} | {STRENGTHS}
inelastic bumper, % | mechanics contact (1.0,0.0) 15.0 400.0 friction_below % | {LEAKS} | {STRENGTHS}
kicks, % | mechanics pendulum (2.0,0.0) 25.0 push=kicks strength=% | {LEAKS}, RKN8 h=0.05 integrate, RKN12 1e-9 |
    {STRENGTHS}
one bead, % | mechanics fput ('mode',8) 60.0 0.25 strength=(0,0,0,0,0,0,0,%) | {LEAKS} | {STRENGTHS}
= wrong gradient
times % | spoilt henon % | RK45 1e-6 | each=(2,-1,0.9)
times 2 | compiled_spring doubled=True | RK4 h=0.02 integrate
a component missing | spoilt moving 0.0 1 | RK45 1e-6
a component's sign | spoilt moving -1.0 1 | RK45 1e-6, RK4 h=0.02
components permuted | spoilt moving way=permuted | RK45 1e-6
complex, the conjugate | spoilt waves way=conjugated | RK45 1e-6
complex, times 2 | spoilt waves 2.0 | RK4 h=4e-3
a component missing, 0 at the start | spoilt chain 0.0 4 | RK45 1e-6, RK4 h=0.05, DOP853 1e-8
a component of the wrong sign, 0 at the start | spoilt chain -1.0 4 | RK45 1e-6, RK4 h=0.05, DOP853 1e-8
a component times 3, 0 at the start | spoilt chain 3.0 4 | RK45 1e-6, RK4 h=0.05, DOP853 1e-8
most of them of the wrong sign, 0 at the start | spoilt chain -1.0 [2,3,4,5,8,9,10,11] | RK45 1e-4, RK4 h=0.1
most of them times 3, 0 at the start | spoilt chain 3.0 [2,3,4,5,8,9,10,11] | RK45 1e-4, RK4 h=0.1
components swapped, 0 at the start | spoilt chain way=swapped | RK45 1e-6
= step too long
y'' = -y | compiled_spring end=60.0 | RK4 h=3, RK4 h=2.5, RK4 h=3 integrate, RK3 h=2, RK2 h=1.5, RK1 h=1, RK5 h=3,
    RK4 h=3 metric=euclidean, RK4 h=3 every=10, RKN8 h=5, RKN12 h=8 integrate
a spring of frequency 1e4 | compiled_spring 1e8 end=2.0 | RK4 h=0.1 integrate, RK4 h=1e-3 integrate,
    RK4 h=4e-4 integrate, RKN12 h=0.01 integrate, RK4 h=0.1 compensated integrate, RK4 h=0.01 interpreted | truth=False
pendulum | mechanics pendulum (2.0,0.0) 100.0 | RK45 1 atol=1, RK4 h=2.5
Kepler, e = 0.6 | kepler 0.6 0.0 60.0 | RK45 1 atol=1, DOP853 1 atol=1 integrate, RK4 h=1, RKN12 h=2
Kepler, e = 0.99, over the pericentre | kepler 0.99 0.0 30.0 | RK4 h=0.1, RK4 h=0.03, RK5 h=0.05 integrate,
    RKN12 h=0.05, RKN12 h=0.2 every=10
Kepler, e = 0.99, from the apocentre | from_apocentre | RK4 h=0.1, RK4 h=0.3, RKN12 h=0.1 integrate
stiff chain | mechanics harmonic (0.1,0,0,0,0,0) 10.0 1e4 | RK4 h=0.05, RK45 10 atol=10 | truth=False
Schroedinger, beyond stability | waves 2.0 | RK4 h=0.05, RK4 h=0.05 metric=euclidean
= light body faster than the steps
planet of mass % at 0.2 | nbody (1.0,1e-3,%) {PLANETARY} | RK2 h=0.3, RK3 h=0.3, RK4 h=0.3 integrate,
    RK5 h=0.3 integrate, RK45 h=0.3, DOP853 h=0.3 integrate, RKN8 h=0.3 integrate, RK4 h=0.1, RK5 h=0.1,
    RK45 h=0.1 integrate | each=(1e-9,0) truth=False
oscillator unknown to the energy | two_oscillators | RK4 h=0.2, RK5 h=0.2 integrate, RKN8 h=0.4
= blown-up passage
Pythagorean bodies | pythagorean | RKN12 h=0.01, RK4 h=1e-3, RKN12 h=0.01 every=10 compensated,
    RK4 h=5e-3 metric=euclidean; integrate
Pythagorean bodies | until pythagorean 20.0 | RKN12 h=0.01, RKN8 h=5e-3, RK45 0.1 atol=0.1
two bodies that meet | nbody (1.0,1.0) ((0.5,0,0),(-0.5,0,0)) ((0,0.02,0),(0,-0.02,0)) t_span=(0.0,3.0) | RK4 h=0.01,
    RKN12 h=0.02 integrate, RK4 h=0.01 metric=euclidean
solar system, steps of 5 and 13 weeks | solar_system years=100.0 | RK4 h=0.1, RKN12 h=0.25; integrate
= faulty members among correct ones
one with friction of 20 | compiled_pendulum members=True | RK4 h=0.05, RK45 1e-6; ensemble | ensemble=friction
one with friction of 20, interpreted | compiled_pendulum members=True | RK4 h=0.05 compiled=False ensemble |
    ensemble=friction
three with friction of 2000, in vectors | compiled_pendulum end=200.0 members=True | RK4 h=0.02 ensemble |
    ensemble=three
one too stiff of 10 | compiled_spring members=True | RK4 h=0.05 ensemble | ensemble=stiff
one with e = 0.99 of 10 | kepler 0.3 0.0 60.0 | RK4 h=0.05 ensemble | ensemble=orbit
two with e = 0.99 of 2000, in vectors | kepler 0.3 0.0 200.0 | RK4 h=0.05 ensemble | ensemble=orbits
all but the first, with friction from 1e-4 to 0.1 | compiled_pendulum members=True | RK2 h=0.02, RK4 h=0.02,
    RK5 h=0.02, RK45 1e-6; ensemble | ensemble=rising
the same among 20000, in vectors | compiled_pendulum members=True | RK2 h=0.02, RK4 h=0.02; ensemble | ensemble=crowd
all of 10 with friction 0.001 | compiled_pendulum members=True | RK45 1e-7 ensemble | ensemble=all
"""


def each(before: str, *options: str) -> str:
    """Return the ways "before option", one for each option."""
    return ", ".join(f"{before} {option}" for option in options)


SPACINGS = ("", "compensated", "every=10", "every=10 compensated", "every=auto", "every=auto compensated")
POINTS = ("metric=euclidean", "direction=old", "direction=midpoint", "iterations=3")
THREE = ", ".join(each(method, "1e-4", "1e-6", "1e-9") for method in ("RK45", "DOP853", "RK5"))
PARTICLE = "RK4 integrate, RK5 integrate, DOP853 integrate, RK45 1e-6, RK4 metric=euclidean integrate"
SMOOTH = "RK45 1e-3, RK45 1e-6, DOP853 1e-8, RK23 1e-4, RK4 h=0.02"
WAVES = "RK45 1e-6, DOP853 1e-8, RK4 h=4e-3, RK4 metric=euclidean h=4e-3, RK4 metric=euclidean h=0.02"
KINKED = "RK5 h=0.02, RK5 h=0.01 integrate, RK2 h=0.01, RK45 1e-6, RK45 1e-9 integrate, DOP853 1e-6, DOP853 1e-9"
LOOSE = "RK45 1e-2, RK23 1e-2, DOP853 1e-2, RK45 1e-3 | each=(0.1,0.01,0.001)"
PAPER = "metric=euclidean reuse_f=False"
OSCILLATOR = ", ".join(each(method, "h=0.02", "h=0.02 integrate") for method in ("RK2", "RK3", "RK4", "RK5"))
PLANETS = ", ".join(each(f"RKN12 h={h}", *SPACINGS) for h in ("0.015625", "0.02", "0.01", "5e-3"))
NAMES = repr(tuple(case.name for case in hard_cases())).replace(" ", "")
DEFAULT = "RK45 rtol=1e-3, DOP853 rtol=1e-3, RK23 rtol=1e-3"

CORRECT = f"""
= the hard cases
% | hard_case % | {THREE} | each={NAMES}
= the problems at their own steps
harmonic oscillator | harmonic | {OSCILLATOR}
Kepler | kepler | RK4, RK4 interpreted, RK4 integrate, RK5 integrate, RK45 integrate, DOP853 integrate, RKN8 integrate,
    RKN12 integrate, RK3 h=0.01 integrate
Kepler without 1/r^3 | kepler 0.6 0.0 | RK4, RK2 h=2e-3; integrate
Kepler, e = 0 | kepler 0.0 0.0 | RK4 integrate, RKN12 integrate, DOP853 1e-8
Kepler, e = 0.9 | kepler 0.9 0.0 50.0 2e-3 | RK4 integrate, RKN12 integrate, DOP853 1e-8
Kepler, e = 0.99 | kepler 0.99 0.0 50.0 2e-4 | RK4 integrate, RKN12 integrate, DOP853 1e-8
Kepler, e = 0.9, in fictitious time | fictitious | RK4 h=0.03, DOP853 1e-8
figure eight | figure_eight 10.0 | RKN12 integrate, RK4 h=0.01 integrate, RKN8 h=0.02 integrate, DOP853 1e-8
Pythagorean bodies to t = 10 | until pythagorean 10.0 | DOP853 1e-10, RK45 1e-8, RKN12 1e-10
Pythagorean bodies | pythagorean | DOP853 1e-13, RKN12 1e-13; integrate
comet | comet | DOP853 1e-9, DOP853 1e-12 integrate, RKN12 1e-11 integrate, RK45 1e-7
particle, uniform field | until uniform_field 2000.0 | {PARTICLE}
particle, tokamak | until tokamak 2000.0 | {PARTICLE}
particle, tokamak, transit | until tokamak 2000.0 transit | {PARTICLE}
soliton | soliton 128 t_end=2.0 | RK4 integrate, RK45 1e-6, DOP853 1e-8
plane wave | plane_wave (16,16) | RK4 integrate, RK45 1e-6
rotating packet, % | rotating_packet % 32 0.2 1e-3 | RK4 integrate, RK3 integrate, DOP853 1e-7 | each=(0,0.5,0.9)
= the solar system over 100 years
Newton | solar_system years=100.0 | {PLANETS}, {each("RK4 h=2e-3", "", "every=10", "metric=euclidean")},
    RK4 h=1e-3 compensated, RK5 h=2e-3, RKN8 h=0.01, RKN8 h=0.01 every=auto, DOP853 h=0.01, DOP853 1e-10; integrate
% | solar_system years=100.0 forces=% | RKN12 h=0.015625 every=10 integrate | each=('gr-potential','j2')
eih, 10 years | solar_system years=10.0 forces=eih | RK4 h=2e-3, DOP853 h=0.01; integrate
= the paper's runs
table 2, harmonic oscillator | harmonic | RK2 h=0.05, RK2 h=0.025, RK2 h=0.0125, RK1 h=0.0125, RK3 h=0.05, RK3 h=0.025,
    RK4 h=0.05, RK4 h=0.025; {PAPER}
tables 3 and 4, Kepler | kepler t_end=1.0 | RK4 h=0.02, RK4 h=0.01, RK4 h=5e-3, RK3 h=0.01,
    RK3 h=5e-3; interpreted {PAPER}
table 5, rotating packet | rotating_packet 0.5 32 0.1 2e-4 nyquist=zero | RK4; {PAPER} integrate
figures 1 and 2, Kepler | kepler | RK4 h=0.03; {PAPER} integrate
solar system | solar_system years=100.0 | RK4 h=2e-3; {PAPER} integrate
particle, uniform field | until uniform_field 5000.0 | RK4; {PAPER} integrate
particle, tokamak | until tokamak 5000.0 | RK4; {PAPER} integrate
= further systems
pendulum | mechanics pendulum (2.0,0.0) | {SMOOTH}
Duffing | mechanics duffing (0.5,0.0) | {SMOOTH}
Henon-Heiles | mechanics henon (0.3,0.2,0.0,0.0) 50.0 | {SMOOTH}
double pendulum | case double_pendulum (9.81,) (1.0,0.5,0.0,0.0) 10.0 | {SMOOTH}
top, from a plane of symmetry | case rigid_body (1.0,2.0,3.0) (0.0,1.0,1.0) 25.0 | {SMOOTH}
top, near its unstable axis | case rigid_body (1.0,2.0,3.0) (1e-3,1.0,1e-3) 25.0 | {SMOOTH}
Toda lattice | mechanics toda {ONE} | {SMOOTH}
FPUT chain | mechanics fput ('mode',16) 50.0 0.25 | {SMOOTH}
sine-Gordon | mechanics sine_gordon ('kinks',64) 20.0 10.24 | {SMOOTH}
pendulum, Verlet's method | mechanics pendulum (2.0,0.0) | Verlet h=0.02
pendulum | compiled_pendulum | RK4 h=0.02, RK45 1e-6, RK2 h=0.01, RK1 h=1e-3; integrate
Henon-Heiles | mechanics henon (0.3,0.2,0.0,0.0) 50.0 | RKN8 1e-8, RKN12 h=0.3
Schroedinger | waves 2.0 | {WAVES}
condensate on a line | waves 2.0 beta=5.0 | {WAVES}
spring | compiled_spring end=100.0 | RK4 h=0.05, RK4 h=0.5, RKN12 h=1, RKN8 1e-8, RK23 1e-3, RK45 1e-4,
    RK45 1e-10; integrate
spring of frequency 1e4 | compiled_spring 1e8 end=0.1 | RK4 h=1e-5, RK45 1e-6; integrate
L in an isotropic trap | compiled_trap 1.0 | RK4 h=0.05, RK45 1e-6, RKN12 h=0.1; integrate
= every, compensated, metric, direction
Kepler | kepler | {each("RK4 h=0.01", *SPACINGS[1:], *POINTS)}, {each("RKN12 h=0.03", *SPACINGS[1:], *POINTS)};
    integrate
Kepler | kepler | {each("RK45 1e-6", "every=10", "every=auto", *POINTS)}
pendulum | mechanics pendulum (2.0,0.0) | {each("RK4 h=0.02", "every=10", "every=auto", *POINTS)}
= kinked forces and cut-offs
huber, % | mechanics huber (1.0,0.1) 20.0 % | {KINKED} | each=(0.1,0.3,0.7)
contact, % | mechanics contact (1.0,0.2) 20.0 % | {KINKED} | each=(30,100)
hertz, % | mechanics hertz (1.0,0.0) 20.0 % | {KINKED} | each=(100,1000)
dead zone, % | mechanics backlash (1.0,0.3) 20.0 % | {KINKED} | each=(0.1,0.5)
cubic walls, 100 | mechanics walls (0.0,1.0) 20.0 100 | {KINKED}
= loose tolerances
rigid body from (0.1, 1.0, 0.1) | case rigid_body (1.0,2.0,3.0) (0.1,1.0,0.1) 25.0 | {DEFAULT}
rigid body from (0.0, 1.0, 1.0) | case rigid_body (1.0,2.0,3.0) (0.0,1.0,1.0) 25.0 | {DEFAULT}
rigid body from (0.5, 0.7, 0.3) | case rigid_body (1.0,2.0,3.0) (0.5,0.7,0.3) 25.0 | {DEFAULT}
SIR (0.5, 0.2), % | epidemic 0.5 0.2 % | {LOOSE}
SIR (0.4, 0.1), % | epidemic 0.4 0.1 % | {LOOSE}
SIR (1.0, 0.3), % | epidemic 1.0 0.3 % | {LOOSE}
SIR (2.0, 1.0), % | epidemic 2.0 1.0 % | {LOOSE}
= ensembles
100 orbits | kepler | RK4, RKN12 every=10; ensemble | ensemble=orbits
100 orbits | kepler t_end=30.0 | RK45 1e-6 ensemble | ensemble=orbits
100 pendulums | compiled_pendulum members=True | RK4 h=0.02 ensemble | ensemble=pendulums
100 solar systems | solar_system years=10.0 | RKN12 h=0.015625 every=10 ensemble | ensemble=planets
2000 orbits, in vectors | kepler 0.3 0.0 200.0 | RK4 h=0.05 ensemble | ensemble=crowd
"""


def among(count: int, others: dict[int, Any], usual: Any = (0.0,)) -> np.ndarray:
    """Return the parameters or starts of `count` members: those of `others` by their indices, and the `usual` ones."""
    rows = np.tile(usual, (count, 1)).astype(float)
    for k, row in others.items():
        rows[k] = row
    return rows


def ensembles(faulty: bool) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return the faulty members and the options of the ensembles, by their names in the tables."""
    orbit, eccentric = kepler(0.3, 0.0).y0, kepler(0.99, 0.0).y0
    few, crowd = (orbit * (1 + 1e-5 * np.arange(count)[:, None]) for count in (10, 2000))
    if not faulty:
        near, nearer = (1 + s * np.random.default_rng(1).standard_normal((100, n)) for s, n in ((1e-2, 4), (1e-6, 60)))
        return {
            "orbits": (False, {"y0s": kepler().y0 * near}),
            "pendulums": (False, {"y0s": np.linspace([0.1, 0.0], [3.0, 0.0], 100), "params": among(100, {})}),
            "planets": (False, {"y0s": solar_system(years=10.0).y0 * nearer}),
            "crowd": (False, {"y0s": crowd}),
        }
    few[6] = crowd[[5, 1500]] = eccentric
    rising = {k + 1: friction for k, friction in enumerate(np.geomspace(1e-4, 0.1, 7))}
    stiff, starts = among(10, {4: (1e8, 0.0, 0.0, 1.0)}, (1.0, 0.0, 0.0, 1.0)), np.linspace([0.9, 0.0], [1.1, 0.0], 10)
    return {
        "friction": ((7,), {"params": among(20, {7: 0.2})}),
        "three": ((3, 1000, 1999), {"params": among(2000, dict.fromkeys((3, 1000, 1999), 0.2))}),
        "stiff": ((4,), {"params": stiff, "y0s": starts}),
        "orbit": ((6,), {"y0s": few}),
        "orbits": ((5, 1500), {"y0s": crowd}),
        "rising": ((*rising,), {"params": among(8, rising)}),
        "crowd": ((*rising,), {"params": among(20_000, rising)}),
        "all": ((*range(10),), {"params": among(10, {}, 1e-3), "y0s": np.linspace([1.0, 0.0], [2.0, 0.0], 10)}),
    }


def all_runs() -> list[Run]:
    """Return all runs, the faulty ones first."""
    return [
        run for table, faulty in ((FAULTY, True), (CORRECT, False)) for run in parsed(table, faulty, ensembles(faulty))
    ]
