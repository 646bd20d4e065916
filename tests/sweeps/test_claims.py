"""Claims: one owner for each unit, until he gives it back, dies, or is silent for too long."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from jaxchain.sweeps import claims
from jaxchain.sweeps.claims import LASTS, TOUCH, Claims, living

OLD = LASTS + 10.0


@pytest.fixture
def others(tmp_path):
    """The claims of another process, as this one sees them."""
    with Claims(tmp_path) as found:
        yield found


@pytest.fixture
def mine(tmp_path):
    with Claims(tmp_path) as found:
        yield found


def age(file, seconds):
    then = time.time() - seconds
    os.utime(file, (then, then))


def names(folder):
    return sorted(file.name for file in folder.iterdir())


def test_a_unit_has_one_owner(tmp_path, mine, others):
    assert others.take("0.1")
    assert not mine.take("0.1")
    assert not others.take("0.1")
    assert mine.take("0.2")
    assert living(tmp_path).keys() == {"0.1", "0.2"}
    assert living(tmp_path)["0.1"]["process"] == os.getpid()
    others.release("0.1")
    assert mine.take("0.1")
    assert names(tmp_path) == ["0.1.claim", "0.2.claim"]


def test_of_many_who_ask_at_once_one_gets_it(tmp_path):
    everybody = [Claims(tmp_path) for _ in range(8)]
    for unit in map(str, range(20)):
        got, together = [], threading.Barrier(len(everybody))

        def ask(one, unit=unit, got=got, together=together):
            together.wait()
            got.append(one.take(unit))

        threads = [threading.Thread(target=ask, args=[one]) for one in everybody]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sum(got) == 1
    for one in everybody:
        one.close()
    assert names(tmp_path) == []


def test_what_is_claimed_is_given_back_in_the_end(tmp_path):
    own = Claims(tmp_path)
    own.take("0")
    with pytest.raises(KeyError), own:
        raise KeyError
    assert names(tmp_path) == []


def test_a_claim_that_nobody_touches_expires(tmp_path, mine, others):
    others.take("0")
    age(tmp_path / "0.claim", LASTS - 10.0)
    assert not mine.take("0")
    assert living(tmp_path).keys() == {"0"}
    age(tmp_path / "0.claim", OLD)
    assert living(tmp_path) == {}
    assert mine.take("0")
    # He who slept does not give back what is no longer his, ...
    others.release("0")
    assert living(tmp_path).keys() == {"0"}
    assert not others.take("0")
    assert names(tmp_path) == ["0.claim"]


def test_a_claim_is_touched_as_long_as_its_owner_lives(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "TOUCH", 0.02)
    with Claims(tmp_path) as own:
        own.take("0")
        age(tmp_path / "0.claim", OLD)
        end = time.monotonic() + 20.0
        while time.time() - (tmp_path / "0.claim").stat().st_mtime > 10.0:
            assert time.monotonic() < end
            time.sleep(0.01)
    assert TOUCH < LASTS / 3


def test_of_several_who_see_that_it_has_expired_one_takes_it(tmp_path, mine, others, monkeypatch):
    """The second one moves away the claim of the first, and sees that it is another one."""
    assert others.take("0")
    age(tmp_path / "0.claim", OLD)
    rename = type(tmp_path).rename

    def late(path, aside):
        monkeypatch.undo()
        with Claims(tmp_path) as first:
            assert first.take("0")
            first._mine.clear()  # it stays
        return rename(path, aside)

    monkeypatch.setattr(type(tmp_path), "rename", late)
    assert not mine.take("0")
    assert names(tmp_path) == ["0.claim"]


@pytest.fixture
def process():
    """One that only lives."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    yield child
    child.kill()
    child.wait()


def claimed_by(child, folder, **about):
    """A claim of this process, as it would have made it."""
    owner = {
        "host": claims._host(), "process": child.pid, "began": claims._began(child.pid),
        "session": None, "claim": "x",
    } | about  # fmt: skip
    (folder / "0.claim").write_text(json.dumps(owner))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_claim_ends_with_its_process(tmp_path, mine, process, number):
    claimed_by(process, tmp_path)
    assert not mine.take("0")
    process.send_signal(number)
    deadline = time.monotonic() + 20.0
    while not mine.take("0"):  # it is dead before anybody has asked how it ended
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert living(tmp_path)["0"]["process"] == os.getpid()


def test_a_process_that_was_only_stopped_keeps_its_claim(tmp_path, mine, process):
    claimed_by(process, tmp_path)
    process.send_signal(signal.SIGSTOP)
    assert not mine.take("0")


def test_the_claim_of_another_process_of_that_number_is_over(tmp_path, mine, process):
    claimed_by(process, tmp_path, began="12")
    assert living(tmp_path) == {}
    assert mine.take("0")


def test_whether_a_process_of_another_computer_lives_is_not_known(tmp_path, mine, process):
    claimed_by(process, tmp_path, host="elsewhere", process=2**22 + 1)
    assert not mine.take("0")
    age(tmp_path / "0.claim", OLD)
    assert mine.take("0")


def test_within_a_session_a_claim_is_whose_turn_it_is(tmp_path):
    with Claims(tmp_path, "a") as one, Claims(tmp_path, "a") as two, Claims(tmp_path, "b") as b:
        assert one.take("0")
        assert not b.take("0")
        assert two.take("0")
        one.release("0")
        assert living(tmp_path).keys() == {"0"}
        assert not b.take("0")


@pytest.mark.parametrize("junk", ["{", "[1]", '{"a": 1}', '{"host": "x", "process": "one"}'])
def test_what_cannot_be_read_is_no_claim(tmp_path, mine, junk):
    (tmp_path / "0.claim").write_text(junk)
    assert living(tmp_path) == {}
    assert mine.take("0")
    assert living(tmp_path).keys() == {"0"}


def test_who_has_claimed_is_seen_where_nothing_can_be_written(tmp_path, mine, monkeypatch):
    assert mine.take("0")

    def full(folder):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(claims, "clock", full)
    assert living(tmp_path).keys() == {"0"}


def test_claims_whose_folder_is_gone_are_given_up_in_silence(tmp_path):
    folder = tmp_path / "units"
    folder.mkdir()
    with Claims(folder) as own:
        own.take("0")
        (folder / "0.claim").unlink()
        folder.rmdir()
