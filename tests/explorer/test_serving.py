"""What the command explores, and what it refuses before a server starts."""

import socket
import subprocess
import sys

import numpy as np
import pytest
from synthetic import results

from jaxchain import equation_8
from jaxchain.cli import main
from jaxchain.explorer import explore
from jaxchain.explorer.serving import explored
from jaxchain.scenes import SceneError


def test_it_is_the_ring_of_twenty_or_a_scene_in_the_middle_of_its_sweep():
    chain, state, stored = explored(None, None, [])
    assert (chain.n, stored) == (20, {})
    np.testing.assert_array_equal(state, equation_8(chain, 5))
    chain, state, _ = explored("fig3", None, [])
    assert (chain.n, round(float(chain.belt_speed), 9)) == (20, 1.45)
    np.testing.assert_array_equal(state[0], equation_8(chain, 10)[0])
    assert explored("fig3", "single", [])[0].n == 1
    with pytest.raises(SceneError, match="no experiment `ladders`; it has: single, ladder"):
        explored("fig3", "ladders", [])


def test_a_folder_of_results_lies_under_the_diagram(tmp_path, monkeypatch):
    def sweep(chain, initial, t1, *, over, **options):
        axes = {name: np.asarray(values) for name, values in over.items()}
        vibrating = np.broadcast_to(axes["excited"], [*map(len, axes.values())])
        return results(axes, vibrating, chain.n)

    monkeypatch.setattr("jaxchain.scenes.running.sweep", sweep)
    few = ["--set", "experiment.ladder.sweep.excited=[0, 6]"]
    folder = str(tmp_path / "results")
    assert main(["run", "quickstart", "--no-plot", "--quiet", "--output", folder, *few]) == 0
    _, _, stored = explored(folder, None, [])
    speeds, energies = stored["belt_speed"]
    assert np.unique(speeds).size == 11
    np.testing.assert_allclose(energies, 11 * [0.0, 6 * 0.5 * 1.5**2])


def test_what_cannot_be_is_refused_before_anything_starts(capsys, chains):
    assert main(["explore", "--port", "70000"]) == 2
    assert "below 65536, but is 70000" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["explore", "--port", str(port), "--no-browser"]) == 2
    assert f"`port` = {port} cannot be used" in capsys.readouterr().err
    with pytest.raises(ValueError, match="must be the pair"):
        explore(chains[1, 1e-2], 3)  # pyright: ignore[reportArgumentType]


def test_the_command_and_the_package_do_not_load_panel():
    code = "import jaxchain.cli, jaxchain, sys; assert 'panel' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
