"""The compiled code of the critical loops: a speed test that does not depend on the load.

A loop is fast on a CPU if it is compiled whole, `jaxchain.configure(whole_loops=True)`, which XLA
does to loops without calls of anything else.
"""

import re

import jax
import jax.numpy as jnp
import pytest

from jaxchain.model.chain import paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.run import simulate

# XLA divides the same loop into more parts from jax 0.11 on, such as 74 with jax 0.12.0 for the
# amplitudes. They take the same CPU time: 64 runs 13 to 15 ms there and with jax 0.10.2.
MORE = 1.25 if jax.__version_info__ >= (0, 11) else 1.0
WHOLE = 'xla_cpu_small_call="true"'


def ensemble(width):
    """Four runs with what an observer sees of them."""
    chain = paper_chain(20, 1.5, width)

    def run(x, v):
        done = simulate(chain, (x, v), 20.0, observe=Amplitude(10.0))
        return done.state, done.observed

    return jax.vmap(run), [jnp.tile(part, (4, 1)) for part in equation_8(chain, 1)]


def loops(text):
    """{name of a computation: its lines} of all that belongs to loops of a compiled program."""
    computations, name = {}, ""
    for line in text.splitlines():
        if head := re.match(r"(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            name = head[1]
            computations[name] = []
        elif line.startswith("  "):
            computations[name].append(line)
    waiting = re.findall(r"body=%?([\w.\-]+)", text)
    found = {}
    while waiting:
        name = waiting.pop()
        if name not in found and name in computations:
            found[name] = computations[name]
            waiting += re.findall(
                r"(?:to_apply|calls|body|condition)=%?([\w.\-]+)", "".join(found[name])
            )
    return found


@pytest.mark.parametrize(("width", "most"), [(1e-3, 65), (None, 115)])
def test_every_loop_is_compiled_whole(width, most):
    function, arguments = ensemble(width)
    text = str(jax.jit(function).lower(*arguments).compile().as_text())
    lines = [line for own in loops(text).values() for line in own]
    for word in ("custom-call(", "scatter(", " sort("):
        assert not [line for line in lines if word in line]
    fusions = sum(" fusion(" in line for line in lines)
    assert most // 2 < fusions <= most * MORE
    inner = sum(" while(" in line for line in lines)
    assert text.count(WHOLE) >= text.count(" while(") - inner > 0


# Each operation outside `jit` is a program of its own, which takes 20 to 60 ms.


def test_a_chain_and_its_start_are_one_program(compiled):
    equation_8(paper_chain(37, 1.5, 1e-2), 2)  # of a size that no other test has
    assert len(compiled) <= 1, compiled
