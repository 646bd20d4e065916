"""The bench measures what it says it does; how fast this machine is, no test asserts."""

import json
import shutil
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxchain.bench.command as bench
from jaxchain import Rodas4, Rodas5P, equation_8, paper_chain, simulate
from jaxchain.bench import peers
from jaxchain.bench import rows_ensembles as ensembles
from jaxchain.bench import rows_solvers as solvers
from jaxchain.bench.compiled_step import compiled_steps
from jaxchain.bench.equal_error import error_of, scan
from jaxchain.bench.rows_steps import plain_steps
from jaxchain.bench.timing import Bar, Row, Sample, format_row, format_table, in_turn


class FakeClock:
    """Stands still unless a side moves it."""

    def __init__(self):
        self.now = 0.0
        self.calls = []

    def __call__(self):
        return self.now

    def side(self, name, seconds):
        durations = iter(seconds)

        def run():
            self.calls.append(name)
            self.now += next(durations)

        return run


def test_sides_are_measured_in_turn_and_the_warm_up_does_not_count():
    clock = FakeClock()
    sides = {
        "a": clock.side("a", [9.0, 1.0, 2.0, 3.0]),
        "b": clock.side("b", [0.75, 0.5, 0.25, 0.5, 0.75]),
    }
    times = in_turn(sides, 3, clock=clock)
    assert clock.calls == ["a", "b", "b", "a", "b", "a", "b", "a", "b"]
    assert times["a"].values == (1.0, 2.0, 3.0)
    assert times["b"].values == (0.25, 0.5, 0.75)


def test_a_fast_side_is_called_until_its_turn_is_long_enough_to_be_measured():
    clock = FakeClock()
    sides = {"fast": clock.side("fast", [0.5, *[2**-10] * 33])}
    times = in_turn(sides, 2, least=2**-6, clock=clock)
    assert len(clock.calls) == 2 + 2 * 16
    assert times["fast"].values == (2**-10, 2**-10)


def test_a_ratio_compares_what_was_measured_in_the_same_turn():
    slowing = Sample((1.0, 2.0, 4.0))
    ratio = Sample((10.0, 20.0, 40.0)).over(slowing)
    assert (ratio.low, ratio.median, ratio.high) == (10.0, 10.0, 10.0)
    assert slowing.per(2).values == (0.5, 1.0, 2.0)


@pytest.mark.parametrize(
    ("bar", "verdict"),
    [
        (Bar("at least", 40.0), "MISSED"),
        (Bar("at least", 30.0), "met"),
        (Bar("at most", 30.0), "MISSED"),
        (Bar("at most", 40.0), "met"),
    ],
)
def test_a_row_says_whether_its_median_meets_the_bar(bar, verdict):
    row = Row(
        "stock", "slow / fast", {"slow": Sample((3.0,))}, Sample((20.0, 35.0, 50.0)), bar=bar
    )
    assert row.met is (verdict == "met")
    assert format_row(row).splitlines()[0].endswith(verdict)


def test_the_table_shows_medians_spread_units_and_notes():
    row = Row(
        "import",
        "import jaxchain",
        {"import jaxchain": Sample((0.07, 0.0712, 0.08))},
        Sample((0.07, 0.0712, 0.08)),
        unit="s",
        bar=Bar("at most", 0.3),
        note="first line\nsecond line",
    )
    skipped = Row("lsoda", "LSODA / jaxchain", bar=Bar("at least", 5.0), note="skipped, no numba")
    lines = format_table([row, skipped]).splitlines()
    assert lines[0].split()[:2] == ["what", "median"]
    assert "71.2 ms (70 ms - 80 ms)" in lines[2]
    assert lines[2].endswith("<= 0.3 s  met")
    assert lines[3].split() == ["import", "jaxchain", "71.2", "ms", "70", "ms", "-", "80", "ms"]
    assert [line.strip() for line in lines[4:6]] == ["first line", "second line"]
    assert lines[6].endswith(">= 5  not measured")
    assert lines[7].strip() == "skipped, no numba"


def test_json_holds_every_measurement():
    row = Row("a", "b", {"c": Sample((1.0, 2.0, 4.0))}, Sample((3.0,)), bar=Bar("at least", 2.0))
    data = json.loads(json.dumps(row.to_dict()))
    assert data["measured"] == {"c": {"median": 2.0, "values": [1.0, 2.0, 4.0]}}
    assert (data["score"], data["spread"], data["met"]) == (3.0, [3.0, 3.0], True)


def test_a_setting_counts_only_if_the_next_tighter_one_holds_too():
    errors = {1e-3: 1e-9, 1e-4: 1e-2, 1e-5: 1e-6, 1e-6: 1e-7, 1e-7: 1e-8}

    def solve(rtol):
        return np.full((2, 3), errors[rtol])

    settings = scan("lucky at 1e-3", solve, np.zeros((2, 3)), 1e-5, tolerances=list(errors))
    assert [s.rtol for s in settings] == [1e-5, 1e-6]


def test_a_failed_run_has_an_infinite_error():
    assert error_of(np.array([[np.nan, 0.0]]), np.zeros((1, 2))) == np.inf


@pytest.fixture(scope="module")
def ring():
    pytest.importorskip("numba")
    return peers.CompiledRing(5)


@pytest.fixture
def case():
    chain = paper_chain(5, belt_speed=1.3, width=1e-2).with_(stiffness=1.1, damping_ratio=0.07)
    x, v = np.random.default_rng(0).normal(size=(2, 5))
    v[2] = 1.3 + 0.004  # within the layer where a mass sticks
    return chain, (jnp.asarray(x), jnp.asarray(v))


def test_the_peers_right_side_is_that_of_the_chain(ring, case):
    chain, state = case
    slope = ring.force(0.0, ring.fold(state), ring.parameters(chain))
    np.testing.assert_allclose(ring.unfold(slope), np.stack(chain(0.0, state)), rtol=1e-13)


def test_the_peers_jacobian_is_that_of_the_chain(ring, case):
    chain, state = case
    expected = np.asarray(chain.jacobian(0.0, state))
    place = np.stack([ring.order, ring.order + 5], axis=-1).ravel()
    expected = expected[np.ix_(place, place)]
    y, p = ring.fold(state), ring.parameters(chain)
    full = np.full((10, 10), np.nan)
    ring.full_jacobian_into(0.0, y, y, full, p)
    np.testing.assert_allclose(full, expected, rtol=1e-12, atol=1e-14)
    band = ring.jacobian(0.0, y, p)
    half = peers.HALF_BANDWIDTH
    for i, j in np.ndindex(10, 10):
        within = band[half + i - j, j] if abs(i - j) <= half else 0.0
        assert within == pytest.approx(expected[i, j], rel=1e-12, abs=1e-14)


def test_unfold_undoes_fold(ring):
    state = np.random.default_rng(1).normal(size=(2, 5))
    np.testing.assert_array_equal(ring.unfold(ring.fold((state[0], state[1]))), state)


def test_a_chain_that_the_peer_cannot_run_is_refused(ring):
    with pytest.raises(ValueError, match="normal load"):
        ring.parameters(paper_chain(5).with_(normal_load=1.0))
    with pytest.raises(ValueError, match="ring"):
        ring.parameters(paper_chain(5).with_(ends="free"))


@pytest.mark.parametrize("make", [pytest.param(peers.lsoda, marks=pytest.mark.long), peers.cvode])
def test_a_peer_integrates_to_the_same_state(ring, make):
    if make is peers.cvode:
        pytest.importorskip("sksundae")
    chain = paper_chain(5, belt_speed=1.3, width=1e-2)
    initial = equation_8(chain, 2)
    x, v = simulate(chain, initial, 3.0, rtol=1e-9).state
    np.testing.assert_allclose(make(ring, chain, initial, 3.0)(1e-9), np.stack([x, v]), atol=1e-6)


def test_without_numba_the_row_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    (row,) = solvers.lsoda_row(1)
    assert "pip install 'jaxchain[peers]'" in row.note
    assert row.met is None


@pytest.mark.skipif(not (shutil.which("gcc") or shutil.which("cc")), reason="no C compiler")
@pytest.mark.parametrize(
    "solver", [Rodas4(sweeps=2), pytest.param(Rodas5P(sweeps=2), marks=pytest.mark.long)]
)
def test_the_step_in_c_does_the_arithmetic_of_the_step(solver):
    chains = [paper_chain(5, belt_speed, 1e-2) for belt_speed in (1.2, 1.3)]
    loop = compiled_steps(chains, solver.tableau, sweeps=2)
    state = jax.tree.map(lambda *parts: jnp.stack(parts), *(equation_8(c, 2) for c in chains))
    x, v = loop(50, 0.02, *state)
    for i, chain in enumerate(chains):
        own = jax.tree.map(lambda part, i=i: part[i], state)
        expected, _ = jax.jit(plain_steps(solver))(chain, own, 0.02, 50)
        np.testing.assert_allclose(np.stack([x[i], v[i]]), np.stack(expected), atol=1e-10)


@pytest.mark.long
def test_the_stock_solvers_solve_the_same_problem(monkeypatch):
    monkeypatch.setattr(solvers, "SPAN", 2.0)
    chain = paper_chain(4, belt_speed=1.3, width=0.1)
    initial = equation_8(chain, 2)
    explicit, split = (
        jax.jit(solvers.stock(solver))(chain, initial, 1e-6, (0.4, 0.3))
        for solver in (diffrax.Tsit5(), diffrax.KenCarp3())
    )
    assert error_of(explicit, split) < 1e-4


def test_half_of_the_mixed_starts_rest_but_for_a_kick():
    chain = paper_chain()
    spread = [float(jnp.ptp(ensembles.mixed_start(chain, start)[0])) for start in range(16)]
    assert spread[:8] == [0.0] * 8
    assert min(spread[8:]) >= 2.0


def test_one_device_skips_the_row_about_two(monkeypatch):
    device = jax.local_devices()[:1]
    monkeypatch.setattr(jax, "local_devices", lambda **_: device)
    (row,) = ensembles.devices_row(1)
    assert "JAX_NUM_CPU_DEVICES=2" in row.note


def test_a_row_that_fails_hides_no_other(monkeypatch, capsys):
    def broken(_):
        raise RuntimeError("out of luck")

    def fine(repeats):
        return [Row("size", "fine", {"side": Sample((1.0,) * repeats)})]

    rows_of = {"stock": broken, "size": fine}
    monkeypatch.setattr(bench, "_measure", lambda name, repeats: rows_of[name](repeats))
    assert bench.main(["--rows", "stock", "size", "--repeats", "2", "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows[0]["note"] == "failed: RuntimeError: out of luck"
    assert rows[1]["measured"]["side"]["values"] == [1.0, 1.0]
    assert bench.main(["--rows", "size"]) == 0
    assert "size: fine" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--rows", "speed"], ["--repeats", "0"]])
def test_a_misused_command_ends_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        bench.main(arguments)
    assert stop.value.code == 2
    assert "jaxchain bench" in capsys.readouterr().err


@pytest.mark.long
def test_the_import_row_measures_a_fresh_interpreter():
    imports, command = bench._measure("import", 1)
    for row in (imports, command):
        assert row.score is not None
        assert row.score.median > 0
