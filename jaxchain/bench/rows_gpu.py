"""The row about a GPU: ensembles smoothed and with true dry friction there, and on a CPU core."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.bench.timing import Row, comparison, compiled, in_turn
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.accuracy import choose_solver
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate

N, WIDTH, EXCITED = 20, 1e-3, 10
BELT_SPEEDS = (1.4, 1.6)


def find_gpu() -> Any:
    """The first one that JAX sees, or None."""
    try:
        return jax.devices("gpu")[0]
    except RuntimeError:
        return None


def gpu_row(
    repeats: int, lanes: int = 4096, few: int = 64, span: float = 100.0, device: Any = None
) -> list[Row]:
    """`lanes` runs at a time on the GPU, and `few` at a time on a core, as each likes best."""
    device = find_gpu() if device is None else device
    if device is None:
        note = "skipped, JAX sees no GPU here; where there is one: pip install 'jaxchain[cuda]'"
        return [Row("gpu", "one CPU core / GPU, a lane, smoothed and nonsmooth", note=note)]
    places = {
        f"CPU core, {few} lanes": (jax.local_devices(backend="cpu")[0], few),
        f"{device.device_kind}, {lanes} lanes": (device, lanes),
    }
    smoothed = paper_chain(N, 1.5, WIDTH)
    # The loosest tolerance that is right at this width, and that of the row `dry`.
    loose = choose_solver(smoothed, 1e-5)
    return [
        _compare(repeats, f"smoothed, width {WIDTH:g}", smoothed, loose, 1e-5, span, places),
        _compare(repeats, "nonsmooth", smoothed, EventDriven(), 1e-6, span, places),
    ]


def _compare(
    repeats: int, kind: str, chain: Chain, solver: Any, rtol: float, span: float,
    places: dict[str, tuple[Any, int]],
) -> Row:  # fmt: skip
    def one(belt_speed: Any) -> Any:
        own = chain.with_(belt_speed=belt_speed)
        return simulate(
            own, equation_8(own, EXCITED), span, observe=Amplitude(window=0.1 * span),
            solver=solver, rtol=rtol, throw=False,
        ).observed  # fmt: skip

    sides: dict[str, Callable[[], Any]] = {}
    seconds, ends = [], []
    for name, (device, lanes) in places.items():
        with jax.default_device(device):
            speeds = jnp.linspace(*BELT_SPEEDS, lanes)
            program, taken = compiled(jax.vmap(one), speeds)
        sides[name] = lambda program=program, speeds=speeds: program(speeds)
        seconds.append(taken)
        # The first and the last belt speed are the same on both.
        ends.append(np.asarray(sides[name]())[[0, -1]])
    times = in_turn(sides, repeats)
    apart = float(np.max(np.abs(ends[0] - ends[1])))
    return comparison(
        "gpu",
        f"one CPU core / GPU, a lane, {kind}",
        {name: times[name].per(lanes) for name, (_, lanes) in places.items()},
        list(places),
        note=f"N {N}, {EXCITED} excited, rtol {rtol:g}, tau {span:g}; amplitudes differ by "
        f"{apart:.0e}\ncompiled in {seconds[0]:.1f} s and {seconds[1]:.1f} s",
    )
