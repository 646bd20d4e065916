import jax
import jax.numpy as jnp
import pytest

from jaxchain import ExponentialDecay, equation_8, paper_chain, sweep
from jaxchain._checks import (
    check_at_least,
    check_one_of,
    check_per_mass,
    check_positive,
)


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


def test_arrays_of_different_lengths_and_matrices_are_refused_even_when_traced():
    check_per_mass(a=1.0, b=jnp.ones(3), c=jnp.ones(3))
    with pytest.raises(ValueError, match=r"`a` has shape \(3,\) and `c` has shape \(2,\)"):
        check_per_mass(a=jnp.ones(3), b=1.0, c=jnp.ones(2))
    with pytest.raises(ValueError, match="agree in length"):
        jax.eval_shape(lambda a: check_per_mass(a=a, b=jnp.ones(2)), jnp.ones(3))
    with pytest.raises(ValueError, match=r"`a` must be one number.*\(2, 3\).*vmap"):
        check_per_mass(a=jnp.ones((2, 3)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: ExponentialDecay(1.0, 0.5, 0.5).with_(mu_sttic=1.0),
            r"`ExponentialDecay.with_` does not know \['mu_sttic'\] \(did you mean `mu_static`",
        ),
        (
            lambda: sweep(paper_chain(1), equation_8, 1.0, over={"damping_rate": [0.1]}),
            r"names 'damping_rate', .* or `vary` \(did you mean `damping_ratio`\?\); allowed are",
        ),
        (
            lambda: check_one_of("of", "velosity", ("displacement", "velocity")),
            r"but is 'velosity' \(did you mean `velocity`\?\)\.$",
        ),
        (lambda: check_one_of("end", "xyz", ("top", "bottom")), r"but is 'xyz'\.$"),
    ],
)
def test_a_misspelt_name_is_refused_with_the_nearest_known_one(call, message):
    with pytest.raises(ValueError, match=message):
        call()
