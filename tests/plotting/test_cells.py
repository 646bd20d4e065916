"""The drawing of a mechanical cell: its links make its matrices, and each part has its symbol."""

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from jaxchain.model import Contact, Coulomb, ExponentialDecay, MechanicalCells, Stop
from jaxchain.plotting.cells import drawn_cells
from jaxchain.plotting.model import draw_model
from jaxchain.plotting.style import STYLE

LAW = ExponentialDecay(0.5, 0.3, 0.5)
K = np.array([[2.0, -0.3, -0.2], [-0.3, 1.1, 0.4], [-0.2, 0.4, 1.4]])
CONTACTS = [
    Contact((1, 0, 0), LAW, 3.0, 0.4),
    Contact((1, 0, 0), LAW, 3.0, -0.4),
    Contact((-1, 1, 0), LAW, 0.8),
    Contact((-1, 0, 1), Coulomb(0.3), 0.7),
]
BLOCKS = MechanicalCells(
    K, mass=[2.0, 0.8, 0.7], damping=0.02, contacts=CONTACTS,
    stops=[Stop((0, 1, 0), 0.1), Stop((0, -1, 0), 0.1), Stop((0, 1, -2), 0.3)],
    force=jnp.array([0.0, 0.5, 0.4]), frequency=0.7,
)  # fmt: skip


def made(links, kind):
    """The matrix of springs or dashpots by their energy 1/2 k (q_i - q_j)^2."""
    whole = np.zeros((3, 3))
    for link in links:
        if link.kind == kind:
            e = np.eye(3)[link.i] - (0.0 if link.j is None else np.eye(3)[link.j])
            whole += link.value * np.outer(e, e)
    return whole


def test_springs_and_dashpots_make_the_matrices():
    added = BLOCKS.with_(damping=0.05)
    cells = MechanicalCells(K, damping=np.diag([0.1, 0.2, 0.0]), plus={"soft": 0.1 * K})
    for model, stiffness, damping in (
        (added, K, 0.05 * np.eye(3)),
        (cells.with_(soft=-2.0), 0.8 * K, np.diag([0.1, 0.2, 0.0])),
    ):
        links = drawn_cells(model).links
        np.testing.assert_allclose(made(links, "spring"), stiffness, atol=1e-15)
        np.testing.assert_allclose(made(links, "dashpot"), damping, atol=1e-15)
    (flutter,) = drawn_cells(MechanicalCells([[2.0, 1.0], [0.0, 1.0]])).notes[:1]
    assert flutter == "The stiffness is not symmetric: its symmetric part is drawn."


def test_each_contact_stop_and_force_has_its_symbol():
    drawn = drawn_cells(BLOCKS)
    ends = {kind: [(link.i, link.j) for link in drawn.links if link.kind == kind]
            for kind in ("friction", "stop", "force")}  # fmt: skip
    assert ends == {
        "friction": [(0, 1), (0, 2)],
        "stop": [(1, None), (1, None), (1, 2)],
        "force": [(1, None), (2, None)],
    }
    assert [link.to_left for link in drawn.links if link.kind == "stop"] == [False, True, False]
    assert [belt[:4] for belt in drawn.belts] == [
        (0, "$v_{d1}$", "$p_{1}$", 0.4), (0, "$v_{d2}$", "$p_{2}$", -0.4),
    ]  # fmt: skip
    assert r"Stop 3: $q_{2}-2\,q_{3} \leq g_{3}$." in drawn.notes
    page = draw_model(BLOCKS)
    left, _ = page.axes
    # Three displacements, two loads and two belts, two contacts between blocks, two forces.
    assert sum(isinstance(p, FancyArrowPatch) for p in left.patches) == 3 + 2 + 2 + 2 + 2
    with matplotlib.rc_context(STYLE):
        page.draw_without_rendering()
    boxes = [text.get_window_extent() for text in left.texts if text.get_text()]
    for i, box in enumerate(boxes):  # no two labels overlap
        assert not any(box.overlaps(other) for other in boxes[:i])


def test_cells_in_a_row_have_a_frame_and_those_on_their_own_have_none():
    row = MechanicalCells([[2.0, -1.0], [-1.0, 2.0]], coupling=0.1, n=4, ends="free")
    assert drawn_cells(row).joined == ("spring", "One of 4 cells in a row.")
    damped = MechanicalCells(1.0, coupling_damping=0.1, n=4)
    assert drawn_cells(damped).joined == ("dashpot", "One of 4 cells in a ring.")
    assert drawn_cells(BLOCKS).joined == ("", "")
    axes = Figure().subplots(1, 2)
    assert draw_model(row, axes=axes).axes == [*axes]
    (_,) = draw_model(row).axes  # without friction there is no law


def test_what_changes_in_time_says_so():
    pads = MechanicalCells(
        [[2.0, 0.3], [0.3, 1.0]],
        friction=LAW.with_(width=0.05),
        belt_speed=lambda t: 0.6 * jnp.cos(t),
        normal_load=lambda t, q, v: 1.5 * q[1],
        force=lambda t: (0.0, jnp.sin(t)),
        names=["along", "across"],
    )
    drawn = drawn_cells(pads)
    assert drawn.belts == [(0, "$v_{d}(t)$", "$p(t)$", 0.6, True)]
    assert drawn.names == ("along", "across")
    forces = [link.name for link in drawn.links if link.kind == "force"]
    assert forces == ["$f_{1}(t)$", "$f_{2}(t)$"]
    assert "Dashed springs and dashpots are negative." in drawn.notes
    _, right = draw_model(pads).axes  # a belt that goes to and fro has no steady sliding
    assert "steady sliding" not in right.get_legend_handles_labels()[1]
