"""The interface of diffrax that the wrapped solver uses."""

from pathlib import Path

import diffrax as dfx

from jaxchain.simulation.smoothed import SETTLED


def test_the_result_that_ends_a_settled_run_is_returned_by_one_unused_controller_alone():
    assert dfx.RESULTS.max_steps_rejected == SETTLED
    package = Path(dfx.__file__).parent
    used = {
        path.name for path in package.rglob("*.py") if "max_steps_rejected" in path.read_text()
    }
    # Where it is defined, and the controller that steps to given times, which no plan has.
    assert used == {"_solution.py", "clip.py"}
