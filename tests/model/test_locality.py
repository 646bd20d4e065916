"""What forces depend on, as read off their traces."""

import jax.numpy as jnp

from jaxchain.model import locality


class Field:
    """Enough of a model: a force that a user may write again and again."""

    def __init__(self, number):
        self.number = number

    def local_force(self, t, x, v):
        return self.number * x


def test_answers_are_remembered_and_the_oldest_are_forgotten(monkeypatch):
    """A key holds the model's functions: hours of work in one session would keep all of them."""
    monkeypatch.setattr(locality, "_KNOWN", remembered := {})
    traced = []

    def dependence(field):
        def find():
            traced.append(field)
            zeros = jnp.zeros(()), jnp.zeros(1), jnp.zeros(1)
            return locality.depends_on(field.local_force, *zeros)

        return locality._once(field, 1, find)

    first = Field(0)
    assert dependence(first) == dependence(first) == (False, True, False)
    for number in range(200):
        dependence(Field(number))
        dependence(first)  # which is in use
    assert len(remembered) <= 64
    assert traced.count(first) == 1
