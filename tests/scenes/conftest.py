"""Made-up sweeps, and files that cannot grow: what several tests of folders of results need."""

import resource
import signal

import pytest
import synthetic

from jaxchain.scenes import running


@pytest.fixture
def short_of_room():
    """No file may grow beyond 60 kB, until the function is called that this returns."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def lift():
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    yield lift
    lift()
    signal.signal(signal.SIGXFSZ, handler)


@pytest.fixture(scope="module")
def made_up_sweep():
    """Replaces the computation: the last run of three masses fails; lists the calls."""
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "sweep", synthetic.recorded_sweep(calls, fails=True))
        yield calls
