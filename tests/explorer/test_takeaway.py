"""What a visitor takes away makes the same numbers again."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxchain import equation_8
from jaxchain.explorer.session import Session
from jaxchain.explorer.takeaway import follow_link, link, scene, snippet, table
from jaxchain.model import Contact, ExponentialDecay, MechanicalCells, StaticKinetic, Stop, Table
from jaxchain.model.ready_made import VanDerPol
from jaxchain.scenes import load_scene
from jaxchain.scenes.building import build


@pytest.fixture
def session(chains):
    chain = chains[3, 1e-2]
    session = Session(chain, equation_8(chain, 1))
    for _ in range(7):
        session.advance(1.0)
    session.change(belt_speed=1.0 / 3.0, coupling=0.01 * np.pi)
    session.advance(0.3)
    return session


def test_the_program_gives_the_state_in_a_fresh_python(session, tmp_path):
    file = tmp_path / "explored.py"
    also = "import sys\nprint(*(x.hex() for x in [*state[0].tolist(), *state[1].tolist()]))\n"
    also += "print(*(float(x).hex() for x in model.parameters().values()))\n"
    file.write_text(snippet(session) + also, encoding="utf-8")
    done = subprocess.run([sys.executable, file], capture_output=True, text=True, check=True)
    *_, state, numbers = done.stdout.splitlines()
    found = np.array([float.fromhex(word) for word in state.split()])
    np.testing.assert_allclose(found, np.concatenate(session.run.state), rtol=0, atol=1e-12)
    given = [float(value) for value in session.model.parameters().values()]
    np.testing.assert_allclose([float.fromhex(w) for w in numbers.split()], given, rtol=1e-12)


MODELS = {
    "dry chain": lambda chains: (chains[3, None], equation_8(chains[3, None], 1)),
    "a block on a block, and a stop": lambda _: (
        MechanicalCells(
            [[1.0, -0.2], [-0.2, 2.0]], mass=[1.0, 0.5], names=["lower", "upper"],
            force=Table([0.0, 1.0], [0.0, 1.0]), plus={"softer": [[0.3, 0.0], [0.0, 0.0]]},
            contacts=[
                Contact((1, 0), StaticKinetic(0.5, 0.3), Table([0.0, 1.0], [1.0, 1.5], 2.0), 0.2),
                Contact((-1, 1), ExponentialDecay(0.4, 0.2, 0.5), [0.5, 0.6]),
            ],
            stops=[Stop((0, 1), [0.4, 0.5], 0.7)],
        ).with_(softer=0.25),
        tuple(np.full((4, 2), 0.1)),
    ),
    "van der Pol": lambda _: (VanDerPol(1.0), tuple(np.ones((2, 2)))),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_the_program_makes_the_same_model(name, chains):
    session, namespace = Session(*MODELS[name](chains)), {}
    exec(snippet(session).partition("# It goes on")[0], namespace)
    assert jax.tree.structure(namespace["model"]) == jax.tree.structure(session.model)
    for a, b in zip(*map(jax.tree.leaves, (namespace["model"], session.model)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_model_with_a_function_has_no_program():
    session = Session(MechanicalCells(1.0, spring=lambda e: e), tuple(np.zeros((2, 2))))
    for write in (snippet, scene):
        with pytest.raises(ValueError, match=r"function of yours|take the program"):
            write(session)


@pytest.mark.parametrize("name", ["smoothed", *MODELS])
def test_the_scene_begins_with_the_state(name, session, chains, tmp_path):
    session = session if name == "smoothed" else Session(*MODELS[name](chains))
    file = tmp_path / "explored.toml"
    file.write_text(scene(session), encoding="utf-8")
    loaded = load_scene(str(file))
    built = build(loaded)["present"]
    for a, b in zip(built.initial(built.model), session.run.state, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)
    swept = loaded.scene.experiment["present"].sweep or {}
    numbers = built.model.with_(**{key: v[0] for key, v in swept.items()}).parameters()
    for key, value in session.model.parameters().items():
        np.testing.assert_allclose(numbers[key], value, rtol=1e-12, atol=1e-14)
    assert (loaded.scene.experiment["present"].numerics.model == "dry") == session.model.dry


def test_a_link_leads_back_and_a_wrong_one_is_refused(session, chains):
    other = Session(chains[3, 1e-2], equation_8(chains[3, 1e-2], 3))
    follow_link(other, link(session))
    assert other.mass == session.mass
    for slider in session.sliders:
        assert other.value(slider.name) == session.value(slider.name)
    for a, b in zip(other.run.state, session.run.state, strict=True):
        np.testing.assert_array_equal(a, b)
    for query, message in (
        ({"belt_speed": "1e400"}, "must be finite"),
        ({"belt_speed": "exec('1')"}, "no number"),
        ({"nonsense": "1"}, "names `nonsense`"),
        ({"state": "a; b"}, "typed in numbers"),
        ({"width": "-1"}, "`width` must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            follow_link(other, query)


def test_the_table_has_a_column_for_each_variable_of_each_mass(session):
    head, *rows = table(session).splitlines()
    assert head.split(",")[:2] == ["time", "displacement_1"]
    numbers = np.array([[float(word) for word in row.split(",")] for row in rows])
    times, parts = session.run.window(1e9)
    np.testing.assert_array_equal(numbers[:, 0], times)
    np.testing.assert_array_equal(numbers[:, 2], parts[2][:, 1])
    np.testing.assert_array_equal(numbers[-1, 4:], parts[3][-1])
