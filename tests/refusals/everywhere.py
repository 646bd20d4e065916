"""NaN, infinity and what cannot be, in runs, sweeps, scenes and SI units."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import Chain, paper_chain, steady_sliding
from jaxchain.model.friction import Coulomb, ExponentialDecay, TanhFriction, WeakeningStrengthening
from jaxchain.model.initial_states import excited_state
from jaxchain.model.parameters import CHAIN
from jaxchain.model.units import Scales
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.samples import Trajectory
from jaxchain.observers.section import PeakTimes, Section
from jaxchain.scenes.files import SceneError
from jaxchain.scenes.scene import load_scene
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.sweeps.sweeping import sweep

NOT_NUMBERS = (math.nan, math.inf, -math.inf)
FINITE = "finite|integer|whole|lie in"
# Every number of a scene, in the built-in one that is tried.
SCENE = "quickstart"
SCENE_NUMBERS = (
    *(f"chain.{name}" for name in CHAIN), "chain.friction.width", "chain.friction.mu_static",
    "chain.friction.mu_dynamic", "chain.friction.v_ref", "time.transient", "time.window",
    "observe.tolerance", "observe.quiet_below", "observe.repeats", "numerics.rtol",
    "numerics.atol", "numerics.max_step", "numerics.max_steps", "numerics.lanes", "chain.n",
)  # fmt: skip


class Refusal(NamedTuple):
    """Calls that must be refused: every attempt raises an error whose text matches `names`."""

    name: str
    names: str
    attempts: Sequence[Callable[[], object]]
    errors: tuple[type[Exception], ...] = (ValueError,)

    def faults(self) -> Iterator[str]:
        for attempt in self.attempts:
            try:
                attempt()
            except self.errors as error:
                if not re.search(self.names, str(error)):
                    yield f'{self.name}: says "{error}", and nothing of "{self.names}"'
            except Exception as error:
                yield f"{self.name}: {type(error).__name__}: {error}"
            else:
                yield f"{self.name}: {attempt} was taken without a word"


def _tried(
    make: Callable[..., object], good: Mapping[str, Any], bad: Any = NOT_NUMBERS
) -> list[Callable[[], object]]:
    """`make` with each of its numbers replaced by each bad value."""
    return [partial(make, **{**good, name: value}) for name in good for value in bad]


def _small() -> tuple[Chain, Any]:
    chain = paper_chain(3, 1.2, 1e-2)
    return chain, (steady_sliding(chain)[0] + 1.0, jnp.zeros(3))


def _not_numbers() -> Iterator[Refusal]:
    chain, start = _small()
    friction = chain.friction
    numbers = {"n": 3, **{name: row.usual for name, row in CHAIN.items()}}

    def refused(name: str, attempts: list[Callable[[], object]], names: str = FINITE) -> Refusal:
        return Refusal(f"NaN, inf in {name}", names, attempts)

    yield refused("every number of Chain", _tried(partial(Chain, friction=friction), numbers))
    yield refused(
        "one entry of an array",
        [
            partial(
                Chain, **{"n": 3, "friction": friction, "belt_speed": 1.0, name: [1.0, v, 1.0]}
            )
            for name, row in CHAIN.items()
            if row.per != "chain"
            for v in NOT_NUMBERS
        ],
        r"index \(1,\)",
    )
    yield refused("`Chain.with_`", _tried(chain.with_, {"width": 1e-2, "mu_static": 1.0}))
    laws = {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5}
    yield refused(
        "every number of friction",
        [
            *_tried(ExponentialDecay, laws),
            *_tried(WeakeningStrengthening, {**laws, "mu_viscous": 0.1}),
            *_tried(Coulomb, {"mu_dynamic": 0.5}),
            *_tried(partial(TanhFriction, chain.law), {"width": 1e-2}),
        ],
    )
    yield refused(
        "initial states",
        [
            *_tried(
                partial(excited_state, chain), {"excited": 1, "amplitude": 2.0, "velocity": 0.0}
            ),
            *(partial(simulate, chain, (start[0] + bad, start[1]), 1.0) for bad in NOT_NUMBERS),
            *(partial(simulate, chain, (start[0], start[1] + bad), 1.0) for bad in NOT_NUMBERS),
        ],
    )
    control = {
        "t1": 1.0, "t0": 0.0, "rtol": 1e-6, "atol": 1e-7, "max_step": 0.5, "max_steps": 100,
    }  # fmt: skip
    yield refused(
        "every number of simulate",
        _tried(partial(simulate, chain, start), {**control, "segments": 2}),
    )
    yield refused(
        "observers",
        [
            *_tried(Amplitude, {"window": 1.0, "tolerance": 1e-6, "quiet_below": 1e-6}),
            *_tried(Amplitude, {"repeats": 5}),
            *_tried(PeakTimes, {"capacity": 4, "start": 0.0}),
            *_tried(partial(Section, 0), {"capacity": 4, "start": 0.0}),
            *(partial(Trajectory, jnp.array([0.5, bad])) for bad in NOT_NUMBERS),
        ],
        FINITE + "|within",
    )
    over = {"belt_speed": [1.0, 1.1]}
    yield refused(
        "every number of sweep",
        [
            *_tried(partial(sweep, chain, start, over=over), {**control, "lanes": 2}),
            *(
                partial(sweep, chain, start, 1.0, over={name: [1.0, bad]})
                for name in (*CHAIN, *chain.friction.parameters())
                for bad in NOT_NUMBERS
            ),
            *(partial(sweep, chain, (start[0] + bad, start[1]), 1.0, over=over)
              for bad in NOT_NUMBERS),
        ],
    )  # fmt: skip
    yield Refusal(
        "NaN, inf in every number of a scene", "finite|whole number|at least|Out of",
        [
            partial(load_scene, SCENE, [f"experiment.ladder.{key}={value}"])
            for key, value in itertools.product(SCENE_NUMBERS, ("nan", "inf", "-inf", "1e400"))
        ],
        (SceneError,),
    )  # fmt: skip
    si = {
        "mass": 1.0, "damping": 0.1, "stiffness": 1.0, "coupling_stiffness": 0.1,
        "normal_load": 1.0,
    }  # fmt: skip
    yield refused("SI units", _tried(Scales.from_dimensional, si))


def _impossible() -> Iterator[Refusal]:
    """Finite, but not to be computed."""
    chain, start = _small()
    run = partial(simulate, chain, start)

    def refused(name: str, names: str, *attempts: Callable[[], object]) -> Refusal:
        return Refusal(name, names, attempts)

    coarse = paper_chain(1, 1.2, 1e-6)
    state = (jnp.full(1, 3.0), jnp.zeros(1))
    yield refused(
        "a width that the tolerance cannot see", "too loose for a regularization width",
        partial(simulate, coarse, state, 50.0, rtol=1e-6),
        partial(sweep, coarse, state, 50.0, over={"width": [1e-2, 1e-7]}, rtol=1e-6),
        partial(simulate, coarse.with_(width=1e-14), state, 50.0, rtol=1e-15),
        partial(simulate, chain, start, 50.0, atol=1e3),
    )  # fmt: skip
    yield refused(
        "a time span in reverse", "backward", partial(run, -1.0), partial(run, 1.0, t0=2)
    )
    yield refused("a tolerance of 1", "below 1", partial(run, 1.0, rtol=1.0))
    yield refused(
        "complex numbers", "real", partial(simulate, chain, (start[0] + 1j, start[1]), 1)
    )
    yield refused(
        "a negative width, load or spring", "positive",
        partial(TanhFriction, chain.law, -1e-3), partial(TanhFriction, chain.law, 0.0),
        partial(chain.with_, normal_load=-1.0), partial(chain.with_, coupling=-1.0),
        partial(chain.with_, mu_dynamic=-0.1), partial(chain.with_, stiffness=0.0),
    )  # fmt: skip
    yield refused(
        "less friction at rest than in motion", "mu_static",
        partial(chain.with_, mu_static=0.4),
        partial(sweep, chain, start, 1.0, over={"mu_static": [0.6, 1], "mu_dynamic": [0.5, 0.8]}),
    )  # fmt: skip
    yield refused(
        "too many masses excited, or a half", "excited",
        *(partial(excited_state, chain, count) for count in (4, -1, 1.5, np.int64(4))),
        partial(sweep, chain, excited_state, 1.0, over={"excited": [1, 4]}),
    )  # fmt: skip
    yield refused(
        "a state of another length", "shape",
        partial(simulate, chain, (jnp.ones(4), jnp.ones(4)), 1.0),
        partial(sweep, chain, (jnp.ones(4), jnp.ones(4)), 1.0, over={"belt_speed": [1.0]}),
    )  # fmt: skip
    wrong_length = TanhFriction(ExponentialDecay(jnp.ones(2), 0.5, 0.5), 1e-3)
    yield refused(
        "friction of another length", "mu_static|friction", partial(Chain, 3, wrong_length, 1.0)
    )
    yield refused(
        "friction that is not a law", "TanhFriction",
        partial(Chain, 3, 0.5, 1.0),
    )  # fmt: skip


def _runs() -> Iterator[Refusal]:
    """Found out on the way."""
    failure = (RuntimeError,)
    chain, start = _small()
    models = {"smoothed": None, "dry": EventDriven()}
    for model, solver in models.items():
        spent = partial(simulate, chain, start, 50.0, max_steps=20, solver=solver)
        yield Refusal(f"max_steps used up, {model}", "max_steps_reached", [spent], failure)
    one = paper_chain(1, 1.2, 1e-2)
    for ratio, end in [(-0.5, 1e4), (-10.0, 1e3), (-1e6, 5.0)]:
        for model, solver in models.items():
            grows = one.with_(damping_ratio=ratio)
            run = partial(
                simulate, grows, (jnp.full(1, 3.0), jnp.zeros(1)), end, solver=solver,
                max_steps=2_000_000,
            )  # fmt: skip
            name = f"damping ratio {ratio:g}, to t = {end:g}, {model}"
            yield Refusal(name, "step_too_small|nonfinite", [run], failure)
    yield Refusal(
        "a state too large to square", "nonfinite|finite",
        [partial(simulate, chain, (jnp.full(3, 1e200), jnp.zeros(3)), 1.0)],
        (RuntimeError, ValueError),
    )  # fmt: skip

    def in_32_bits() -> object:
        with jax.enable_x64(False):
            own, (x, v) = _small()
            return simulate(own, (x, v), 1.0)

    def made_in_32_bits() -> object:
        with jax.enable_x64(False):
            own = _small()[0]
        return simulate(own, start, 1.0)

    yield Refusal("float32 throughout", "64-bit floats", [in_32_bits], failure)
    yield Refusal("a float32 chain", "64-bit floats", [made_in_32_bits])


def rows() -> Iterator[Refusal]:
    yield from _not_numbers()
    yield from _impossible()
    yield from _runs()
