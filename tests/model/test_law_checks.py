"""Impossible friction laws are refused with the speed at which they fail."""

from typing import Any

import jax.numpy as jnp
import pytest

from jaxchain.model.friction import AbstractFrictionLaw


class Law(AbstractFrictionLaw):
    mu_static: Any = 1.0
    a: float = 0.5


class Linear(Law):
    def coefficient(self, speed: Any) -> Any:
        return self.mu_static - self.a * speed


class Jump(Law):
    height: float = 0.1

    def coefficient(self, speed: Any) -> Any:
        return self.mu_static + jnp.where(speed < self.a, 0.0, self.height)


class Pole(Law):
    def coefficient(self, speed: Any) -> Any:
        return self.mu_static + 0.0 / jnp.where(speed < self.a, 1.0, 0.0)


class Scalar(Law):
    def coefficient(self, speed: Any) -> Any:
        return jnp.asarray(self.mu_static)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        # The first of the speeds that are looked at beyond 2.
        (lambda: Linear(1.0, 0.5), r"`Linear` is negative at the speed 2\.0\d+: mu = -0\.0"),
        (lambda: Linear(jnp.array([0.1, 1.0]), 1e-2 / 3), r"negative at the speed 30\.\d+:"),
        (lambda: Pole(), r"`Pole` is not finite at the speed 0\.5\d*: mu = nan"),
        (lambda: Jump(1.0, 0.7), r"`Jump` jumps at the speed 0\.7, by 0\.1\."),
        (lambda: Jump(1.0, 0.0), r"at the speed 0: `mu_static` is 1\.0, but mu\(0\) is 1\.1"),
        (lambda: Jump(1.0, 1e-300), r"jumps at the speed .*, by 0\.1\."),
        (lambda: Scalar(), r"element by element, but of an array of shape .* it makes one of"),
    ],
)
def test_a_curve_that_cannot_be_a_law_is_refused_with_its_speed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
