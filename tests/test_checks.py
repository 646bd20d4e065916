import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import ExponentialDecay, equation_8, paper_chain, sweep
from jaxchain._checks import (
    check_at_least,
    check_count,
    check_finite,
    check_nonnegative,
    check_one_of,
    check_per_mass,
    check_positive,
    check_positive_number,
    check_share,
    check_whole,
)
from jaxchain.boundaries import continue_equilibrium
from jaxchain.model import VanDerPol

CHECKS = (check_finite, check_nonnegative, check_positive)


def test_numbers_are_refused_that_are_not_finite_or_have_the_wrong_sign():
    for check in CHECKS:
        for value in (1, 1.0, np.float32(1.0), jnp.ones(3), np.ones(3)):
            check("a", value, "remedy.")
        for bad in (np.nan, np.inf, -np.inf):
            for value in (bad, jnp.array([1.0, bad])):
                with pytest.raises(ValueError, match="finite"):
                    check("a", value, "remedy.")
    check_nonnegative("a", 0.0, "remedy.")
    check_finite("a", -1.0, "remedy.")
    for check, value in ((check_positive, 0), (check_positive, -1), (check_nonnegative, -1)):
        with pytest.raises(ValueError, match=f"is {value}"):
            check("a", float(value), "remedy.")


def test_the_message_names_argument_value_and_remedy():
    with pytest.raises(ValueError) as error:
        check_positive("width", -0.1, "choose 1e-3.")
    expected = "Argument `width` must be positive and finite, but is -0.1: choose 1e-3."
    assert str(error.value) == expected


def test_a_value_below_its_floor_is_refused_with_both_names():
    check_at_least("a", 1.0, "b", jnp.array([0.5, 1.0]), "remedy.")
    with pytest.raises(ValueError, match=r"`a` must be at least `b` = 1\.0, but is 0\.5"):
        check_at_least("a", 0.5, "b", 1.0, "remedy.")
    with pytest.raises(ValueError, match=r"is 0\.5 at index \(1,\)"):
        check_at_least("a", 0.5, "b", jnp.array([0.5, 1.0]), "remedy.")
    jax.jit(lambda a: check_at_least("a", a, "b", 1.0, "remedy."))(0.5)


def test_arrays_of_different_lengths_and_matrices_are_refused_even_when_traced():
    check_per_mass(a=1.0, b=jnp.ones(3), c=np.ones(3))
    with pytest.raises(ValueError, match=r"`a` has shape \(3,\) and `c` has shape \(2,\)"):
        check_per_mass(a=jnp.ones(3), b=1.0, c=jnp.ones(2))
    with pytest.raises(ValueError, match="agree in length"):
        jax.eval_shape(lambda a: check_per_mass(a=a, b=jnp.ones(2)), jnp.ones(3))
    with pytest.raises(ValueError, match=r"`a` must be one number.*\(2, 3\).*vmap"):
        check_per_mass(a=jnp.ones((2, 3)))


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: check_whole("n", 2.0), "an integer of at least 1, but is 2.0.$"),
        (lambda: check_whole("n", True), "but is True"),
        (lambda: check_whole("n", None, remedy="4, say."), "but is None: 4, say.$"),
        (lambda: check_whole("n", 3, 0, 2), "an integer in 0 ... 2, but is 3"),
        (lambda: check_count("n", 0), "must be None or an integer of at least 1"),
        (lambda: check_one_of("end", "top", ("a", "b", "c")), '"a", "b" or "c", but is \'top\''),
        (lambda: check_share("p", 1.0), "between 0 and 1, but is 1"),
        (lambda: check_share("p", 0.0), "between 0 and 1, but is 0"),
        (lambda: check_positive_number("p", np.ones(2)), r"one number, but has shape \(2,\)"),
        (lambda: check_positive_number("p", 0.0), "positive and finite"),
    ],
)
def test_counts_words_and_shares_are_refused_by_value(check, message):
    with pytest.raises(ValueError, match=message):
        check()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: paper_chain(1).with_(belt_sped=1.0),
            r"`Chain.with_` does not know \['belt_sped'\] \(did you mean `belt_speed`\?\);",
        ),
        (
            lambda: ExponentialDecay(1.0, 0.5, 0.5).with_(mu_sttic=1.0),
            r"`ExponentialDecay.with_` does not know \['mu_sttic'\] \(did you mean `mu_static`",
        ),
        (lambda: VanDerPol(1.0).with_(coupeling=1.0), r"`VanDerPol.with_` .* mean `coupling`"),
        (
            lambda: sweep(paper_chain(1), equation_8, 1.0, over={"damping_rate": [0.1]}),
            r"names 'damping_rate', .* or `vary` \(did you mean `damping_ratio`\?\); allowed are",
        ),
        (
            lambda: check_one_of("of", "velosity", ("displacement", "velocity")),
            r"but is 'velosity' \(did you mean `velocity`\?\)\.$",
        ),
        (
            lambda: continue_equilibrium(
                paper_chain(1), (jnp.ones(1), jnp.zeros(1)), "belt-speed", (1.0, 2.0)
            ),
            r"but is 'belt-speed' \(did you mean `belt_speed`\?\)\.$",
        ),
        (lambda: check_one_of("end", "xyz", ("top", "bottom")), r"but is 'xyz'\.$"),
    ],
)
def test_a_misspelt_name_is_refused_with_the_nearest_known_one(call, message):
    with pytest.raises(ValueError, match=message):
        call()
