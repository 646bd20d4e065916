"""What the tests of several files on folders of results need."""

import resource
import signal

import pytest


@pytest.fixture
def short_of_room():
    """No file may grow beyond 60 kB, until the function is called that this returns."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    own = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def lift(*_):
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    yield lift
    lift()
    signal.signal(signal.SIGXFSZ, own)
