"""Is every stiff or extreme case right?

What a user might try and a program might get wrong without a word: widths from 1 to 1e-12, belts
at rest, reversed and fast, negative and strong damping, couplings from 0 to 1e4, 100,000 masses,
a million time units, starts on the switching surface.  Each case is computed with smoothed and
with true dry friction and compared with an independent witness: SciPy's LSODA for the smoothed
law, DOP853 and closed-form sticking for dry friction, the matrix exponential for linear chains, or
a run that must agree for a reason of its own.

Prints for each case its greatest deviation from the witness, relative to the witness' greatest
number or to 1, what is allowed, and the seconds it takes; a case that is WRONG ends the program
with an error.  Five minutes on two cores:

    python examples/studies/extremes.py
"""

import math
import time
import warnings
from dataclasses import dataclass, replace

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from _common import BLUE, ORANGE, options
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxchain as jc
from jaxchain.observers import EnergyBalance
from jaxchain.plotting import save_figure

WIDTHS = [1.0, 0.1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12]
BELT_SPEEDS, DAMPING_RATIOS = [0.0, 1e-9, -1.2, 100.0], [0.0, -0.05, -10.0, 10.0]
STATIC_TO_DYNAMIC, V_REFS = [1.0, 1.0001, 20.0], [1e-4, 1e4]
COUPLINGS, MASSES, LONG = [0.0, 1e-6, 1.0, 1e4], 100_000, 1e6
BALANCES = [  # belt speed, damping ratio, coupling, width
    (1.3, 0.05, 0.01, 1e-3), (-0.5, 0.0, 1.0, 1e-4), (1e-3, 0.05, 100.0, 1e-5),
    (1.3, -0.02, 0.01, 1e-2), (20.0, 3.0, 1e-6, 1e-3),
]  # fmt: skip
SLOWEST = 60.0  # seconds; a case that takes longer is WRONG
RTOL, MAX_STEPS = 1e-9, 2_000_000
# What a width costs in the state after 50 time units is about 2 eps ln(1 / eps); LSODA follows the
# smoothed law down to the narrowest width.
BIAS, NARROWEST = 6.0, 1e-6
# Cases of smoothed friction alone: dry friction has no width, and no witness for different masses.
SMOOTHED_ALONE = {"width", "all stick, all different"}


@dataclass(frozen=True)
class Mass:
    """One oscillator on the belt, x'' + 2 xi x' + k x = F(x' - v_d), and its witnesses."""

    v_d: float = 1.2
    xi: float = 0.05
    width: float = 1e-6
    mu_static: float = 1.0
    mu_dynamic: float = 0.5
    v_ref: float = 0.5
    k: float = 1.0
    x: float = 3.0
    v: float = 0.0
    end: float = 50.0

    def chain(self, n=1, **more):
        law = jc.ExponentialDecay(self.mu_static, self.mu_dynamic, self.v_ref)
        law = jc.TanhFriction(law, self.width)
        return jc.Chain(n, law, self.v_d, self.xi, stiffness=self.k, **more)

    def mu(self, speed):
        drop = self.mu_static - self.mu_dynamic
        return self.mu_dynamic + drop * np.exp(-np.abs(speed) / self.v_ref)

    def dry(self):
        """The end with true dry friction: slip to the next w = 0, stick in closed form."""
        x, v, t = self.x, self.v, 0.0
        while t < self.end:
            static_force = self.k * x + 2 * self.xi * v  # what friction has to hold
            w = v - self.v_d
            side = math.copysign(1.0, w if w else -static_force)
            if w == 0 and abs(static_force) <= self.mu_static:
                rate, stick = self.k * self.v_d, self.end - t
                if rate:
                    stick = min(stick, (math.copysign(self.mu_static, rate) - static_force) / rate)
                x, t, side = x + self.v_d * stick, t + stick, -math.copysign(1.0, self.v_d)
            if t < self.end:

                def slope(t, y, side):
                    force = -side * self.mu(y[1] - self.v_d)
                    return y[1], force - 2 * self.xi * y[1] - self.k * y[0]

                lands = lambda t, y, side: y[1] - self.v_d
                lands.terminal, lands.direction = True, -side
                run = solve_ivp(
                    slope, (t, self.end), (x, v), "DOP853", args=(side,), rtol=1e-12, atol=1e-14,
                    events=lands, max_step=0.2 / math.sqrt(max(self.k, 1.0)),
                )  # fmt: skip
                x, v, t = run.y[0, -1], self.v_d if run.status == 1 else run.y[1, -1], run.t[-1]
        return np.array([x, v])

    def smoothed(self, x=None, v=None, springs=0.0):
        """The end, also of masses joined by a matrix of springs, by LSODA."""
        x, v = ([self.x], [self.v]) if x is None else (x, v)
        n, stiffness, span = len(x), self.k * np.eye(len(x)) + springs, (0.0, self.end)

        def slope(t, y):
            w = y[n:] - self.v_d
            force = -self.mu(w) * np.tanh(w / self.width)
            return np.concatenate([y[n:], force - 2 * self.xi * y[n:] - stiffness @ y[:n]])

        def jacobian(t, y):
            w = y[n:] - self.v_d
            turn, fall = np.tanh(w / self.width), (self.mu(w) - self.mu_dynamic) / self.v_ref
            d = fall * np.sign(w) * turn - self.mu(w) * (1 - turn**2) / self.width - 2 * self.xi
            return np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, np.diag(d)]])

        y = np.concatenate([x, v])
        run = solve_ivp(slope, span, y, "LSODA", jac=jacobian, rtol=1e-11, atol=1e-12)
        return run.y[:, -1] if run.success else np.full(2 * n, np.nan)


def ring(n, springs, cyclic=True):
    """The matrix of springs between neighbours; spring i joins masses i and i + 1."""
    left = np.eye(n) - np.roll(np.eye(n), 1, axis=1)
    left = left if cyclic else left[:-1]
    return left.T @ np.diag(np.broadcast_to(springs, len(left))) @ left


def linear(stiffness, xi, force, x, v, end):
    """A chain under a constant force on every mass, x'' + 2 xi x' + K x = force, exactly."""
    n = len(x)
    generator = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -2 * xi * np.eye(n)]])
    rest = np.concatenate([np.linalg.solve(stiffness, np.full(n, force)), np.zeros(n)])
    return rest + expm(generator * end) @ (np.concatenate([x, v]) - rest)


def run(model, chain, x, v, t1, rtol=RTOL, **options):
    """A run with one kind of friction; the tolerance follows a small width down."""
    if model == "dry":
        options |= {"solver": jc.EventDriven()}
    else:
        speed = abs(float(chain.belt_speed)) + 0.1
        rtol = min(rtol, float(chain.width) / (60.0 * min(chain.n, 20) ** 0.5 * speed))
    state = tuple(jnp.broadcast_to(jnp.asarray(part, float), (chain.n,)) for part in (x, v))
    return jc.simulate(chain, state, t1, **{"rtol": rtol, "max_steps": MAX_STEPS} | options)


def end(*arguments, **options):
    """(x_1 ... x_n, v_1 ... v_n) at the end of a run."""
    return np.concatenate(run(*arguments, **options).state)


# Answers: (what was computed, its witness, the deviation that is allowed), by one of the models.
def alone(mass, model):
    """One mass: against the smoothed law where LSODA can follow it."""
    value = end(model, mass.chain(), mass.x, mass.v, mass.end)
    if model == "dry":
        return value, mass.dry(), 1e-6
    if mass.width >= NARROWEST:
        return value, mass.smoothed(), 5e-6
    return value, mass.dry(), 1e-6 + BIAS * mass.width * math.log(1 / mass.width)


def tiny(model):
    """Below the Hopf speed a tiny vibration grows as the linearized equations say."""
    slow = replace(SOFT, v_d=0.8)
    rest = float(jc.steady_sliding(slow.chain())[0][0])
    grown = end(model, slow.chain(), rest + 1e-12, 0.0, 50.0, max_step=0.05) - [rest, 0.0]
    slope = (slow.mu(0.8) - slow.mu_dynamic) / slow.v_ref
    return grown / 1e-12, linear(np.eye(1), slow.xi - slope / 2, 0.0, [1.0], [0.0], 50.0), 1e-3


def long(x, allowed, model):
    """After a million time units a run is on the cycle of Newton's method, or at rest."""
    chain, watch = replace(SOFT, width=1e-2).chain(), jc.Amplitude(window=20.0)
    options = {"rtol": 1e-5, "max_steps": None, "observe": watch}
    amplitude = run(model, chain, x, 0.0, LONG, **options).observed
    chain = chain.with_(width=None) if model == "dry" else chain
    return amplitude, jc.find_limit_cycle(chain).amplitude if x > 2.0 else 0.0, allowed


def linear_decay(n, springs, ends, duration, model):
    """Far below the belt's speed Coulomb friction is a constant force: the chain is linear."""
    law = jc.TanhFriction(jc.Coulomb(0.5), 1.0)
    x, v = np.random.default_rng(n).normal(size=(2, n))
    value = end(model, jc.Chain(n, law, 1e4, 0.05, springs, ends=ends), x, v, duration)
    stiffness = np.eye(n) + ring(n, springs, ends == "cyclic")
    return value, linear(stiffness, 0.05, 0.5, x, v, duration), 1e-6


def copies(model):
    """Twenty masses over and over: the large ring does what the small one does."""
    small, big = (FAST.chain(n, coupling=0.01) for n in (20, MASSES))
    x, v = jc.equation_8(small, 9)
    value = end(model, big, *np.tile([x, v], MASSES // 20), 10.0, rtol=1e-6)
    witness = end(model, small, x, v, 10.0).reshape(2, 20)
    return value, np.tile(witness, MASSES // 20).ravel(), 1e-4


def lonely(model):
    """A mean error over all masses must not hide that of the one that vibrates."""
    x, v = jc.steady_sliding(big := FAST.chain(MASSES))
    ended = run(model, big, x.at[0].add(2.0), v, 60.0, rtol=1e-6).state
    one = replace(FAST, x=FAST.mu(1.3) + 2.0, end=60.0)
    return np.array(ended)[:, 0], one.dry() if model == "dry" else one.smoothed(), 1e-4


def together(x, model):
    """All masses stick, on the switching surface, at the start."""
    mass = replace(FAST, end=30.0)
    value = end(model, mass.chain(20, coupling=0.01), x, 1.3, 30.0)
    if model == "dry":
        return value, np.repeat(replace(mass, x=x[0], v=1.3).dry(), 20), 1e-7
    return value, mass.smoothed(x, np.full(20, 1.3), ring(20, 0.01)), 1e-5


def balance(mass, coupling, model):
    """The work of the belt equals the dissipated and stored energy."""
    chain = mass.chain(20, coupling=coupling)
    watch = {"rtol": 1e-8, "observe": EnergyBalance()}
    work, lost, grown = run(model, chain, *jc.equation_8(chain, 9), 50.0, **watch).observed
    return work - lost, grown, 1e-4


SOFT, FAST = Mass(width=1e-3), Mass(width=1e-3, v_d=1.3)


def cases():
    """(group, name, answer, its numbers)."""
    one = Mass()
    for width in WIDTHS:
        yield "width", f"{width:g}", alone, replace(one, width=width)
    for speed in BELT_SPEEDS:
        yield "belt speed", f"{speed:g}", alone, replace(one, v_d=speed)
    for xi in DAMPING_RATIOS:  # a vibration that grows is not followed to where it overflows
        mass = replace(one, xi=xi, end=min(50.0, 20.0 / max(-xi, 0.4)))
        yield "damping", f"ratio {xi:g}", alone, mass
    for ratio in STATIC_TO_DYNAMIC:
        mass = replace(one, mu_static=ratio * one.mu_dynamic)
        yield "friction", f"static / dynamic {ratio:g}", alone, mass
    for v_ref in V_REFS:  # a belt in the middle of the weakening, a layer well below it
        mass = replace(one, v_ref=v_ref, v_d=min(1.2, 2 * v_ref), width=1e-3 * min(v_ref, 1e-2))
        yield "friction", f"v_ref {v_ref:g}", alone, mass
    springs = 10.0 ** np.random.default_rng(1).uniform(-6, 2, 7)
    for eta in COUPLINGS:
        yield "coupling", f"{eta:g}, linear decay", linear_decay, 5, eta, "cyclic", 20.0
    for ends, own in (("cyclic", springs), ("free", springs[:-1])):
        yield "coupling", f"1e-6 to 100 per spring, {ends}", linear_decay, 7, own, ends, 20.0
    for n in (2, 3):
        yield "size", f"{n}, linear decay of a ring", linear_decay, n, 0.5, "cyclic", 50.0
    yield "size", f"{MASSES}, copies of a ring of 20", copies
    yield "size", f"{MASSES}, one vibrates", lonely
    yield "start", "1e-12 from steady sliding", tiny
    yield "start", "1e6 from steady sliding", alone, replace(SOFT, x=SOFT.mu(1.2) + 1e6)
    for name, x in [("held", 0.2), ("about to slip", 0.88), ("torn off at once", 3.0)]:
        yield "start", f"w = 0, {name}", alone, replace(SOFT, v=1.2, x=x)
    yield "start", "all stick, alike", together, np.full(20, 0.2)
    yield "start", "all stick, all different", together, 0.5 * np.cos(np.arange(20))
    yield "time", f"{LONG:g} time units, vibrating", long, 3.0, 1e-4
    yield "time", f"{LONG:g} time units, coming to rest", long, SOFT.mu(1.2) + 0.01, 1e-6
    for k in (1e-4, 1e6):
        mass = replace(one, k=k, x=3.0 / k, end=min(20.0, 2000.0 / k**0.5))
        yield "numbers", f"stiffness {k:g}", alone, mass
    for speed, xi, eta, width in BALANCES:
        name = f"v_d {speed:g}, xi {xi:g}, eta_c {eta:g}"
        yield "balance", name, balance, Mass(speed, xi, width), eta


def judge(group, name, answer, *numbers):
    """A row for each model: how far the answer is from its witness, and whether that is right."""
    for model in ("smoothed",) if {group, name} & SMOOTHED_ALONE else ("smoothed", "dry"):
        begun, deviation, allowed = time.perf_counter(), np.inf, np.nan
        try:
            value, witness, allowed = answer(*numbers, model)
            apart = np.max(np.abs(value - witness)) / max(1.0, np.max(np.abs(witness)))
            deviation = apart if np.isfinite(apart) else np.inf
        except Exception as error:  # whatever it is, it is no answer
            print(f"{group}: {name}, {model}: {type(error).__name__}: {error}")
        seconds = time.perf_counter() - begun
        outcome = "right" if deviation <= allowed and seconds <= SLOWEST else "WRONG"
        yield f"{group}: {name}", model, outcome, deviation, allowed, seconds


def draw(table):
    """One line for each case: deviation beside what is allowed, and seconds with compiling."""
    names = [*table.case.unique()]
    page, (left, right) = plt.subplots(
        1, 2, figsize=(7.0, 0.9 + 0.105 * len(names)), sharey=True, width_ratios=(3, 1)
    )
    row, least = table.case.map(names.index), 1e-16  # exact agreement stands at the edge
    looks = ("smoothed", "o", BLUE, -0.16), ("dry", "s", ORANGE, 0.16)
    for model, marker, colour, shift in looks:
        own = table.model == model
        y, allowed = row[own] + shift, table.allowed[own].clip(least, 1.0)
        x = table.deviation[own].clip(least, 1.0)
        left.hlines(y, x, allowed, colour, linewidth=0.5)
        left.plot(allowed, y, "|", color=colour, markersize=4)
        left.plot(x, y, marker, color=colour, markersize=2.8, label=model)
        right.plot(table.seconds[own].clip(1e-3), y, marker, color=colour, markersize=2.4)
    left.set_yticks(range(len(names)), names, fontsize=5.5)
    left.set(ylim=(len(names) - 0.4, -0.6), xscale="log", xlim=(least / 2, 8.0))
    left.set_xlabel("deviation from the witness, relative (–); |: allowed")
    right.set(xscale="log", xlabel="time (s)")
    page.legend(loc="outside upper center", ncols=3, frameon=False)
    return page


def main():
    quick, folder = options(__file__, __doc__)
    warnings.filterwarnings("ignore", message=".*If it is in SI units")
    some = [case for case in cases() if not quick or case[0] in ("friction", "damping")]
    rows = [row for case in some for row in judge(*case)]
    head = ["case", "model", "outcome", "deviation", "allowed", "seconds"]
    table = pd.DataFrame(rows, columns=head)
    table.to_csv(folder / "extremes.csv", index=False)
    print(table.to_string(index=False, float_format="{:.1e}".format))
    save_figure(draw(table), folder / "extremes")
    if wrong := int((table.outcome == "WRONG").sum()):
        raise SystemExit(f"{wrong} of {len(table)} cases are WRONG")


if __name__ == "__main__":
    main()
