"""The command `jaxchain basins`, but for the boundaries, which `jaxchain boundary` finds, too."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import SearchResult
from jaxchain.basins import SlidingBasin, single_mass
from jaxchain.boundaries import overview
from jaxchain.cli import main


@pytest.fixture(autouse=True)
def asked(monkeypatch, tmp_path):
    """Replaces the search of the boundaries; a list of the chains that were asked for."""
    chains = []
    values = (1.2, 1.2, 1e-12, np.nan, 1.85, 1e-10, 1.85, 1e-3)

    def search(chain):
        chains.append(chain)
        return overview.Boundaries(*map(jnp.asarray, values), mass=0)

    monkeypatch.setattr(overview, "hopf_and_fold", search)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return chains


def record(share, up, down, result):
    one = jnp.ones(1)
    share, up, down, other = map(jnp.asarray, (share, up, down, np.nan))
    return SlidingBasin(
        share=share, area=other, state=(one, one), period=other, up=up, down=down, gap=other,
        result=result,
    )  # fmt: skip


@pytest.fixture
def found(monkeypatch):
    """Replaces the search of the cycle: with dry friction there is one, smoothed there is none."""
    asked = []

    def search(chain, box):
        asked.append((chain, box))
        if chain.dry:
            return record(0.25, 1.1, 1.2, SearchResult.successful)
        if chain.belt_speed == 0:
            return record(np.nan, np.nan, np.nan, SearchResult.creeps)
        return record(1.0, np.inf, np.inf, SearchResult.successful)

    monkeypatch.setattr(single_mass, "sliding_basin", search)
    return asked


def test_it_prints_one_object(asked, found, capsys):
    arguments = ["--width", "0.01", "--belt-speed=-1.78", "--displacement", "-1", "0.5"]
    assert main(["basins", "--json", *arguments]) == 0
    told = json.loads(capsys.readouterr().out)
    assert set(told["missing"]) == {"fold", "blow_up", "blow_down"}
    assert "every motion comes to slide" in told["missing"]["blow_up"]
    assert told["fold"] is told["blow_up"] is None
    assert (told["share"], told["share_nonsmooth"], told["fold_nonsmooth"]) == (1.0, 0.25, 1.85)
    assert (told["blow_up_nonsmooth"], told["blow_down_nonsmooth"]) == (1.1, 1.2)
    assert told["box"] == {"displacement": [-1.0, 0.5], "velocity": [0.0, 2.0]}
    assert told["parameters"] == {
        "width": 0.01, "damping_ratio": 0.05, "mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5,
        "belt_speed": -1.78,
    }  # fmt: skip
    (chain,) = asked
    assert (chain.n, float(chain.width)) == (1, 0.01)
    assert [own.dry for own, _ in found] == [False, True]
    assert all(box.displacement.tolist() == [-1.0, 0.5] for _, box in found)


def test_in_words_it_says_what_is_missing(found, capsys):
    assert main(["basins"]) == 0
    said = capsys.readouterr().out
    assert "belt speed 1.5, starts with -2 <= x <= 2 and 0 <= v <= 2" in said
    share = next(line for line in said.splitlines() if line.startswith("share"))
    assert share.split()[1:3] == ["1.000000000", "0.250000000"]
    assert "blow_up: every motion comes to slide steadily" in said
    assert main(["basins", "--belt-speed", "0"]) == 0
    assert "share: The belt rests" in capsys.readouterr().out


@pytest.mark.long
def test_what_it_prints_is_what_is_found(capsys):
    assert main(["basins", "--json", "--width", "0.01", "--belt-speed=-1.78"]) == 0
    told = json.loads(capsys.readouterr().out)
    # The belt runs backward: up is what is down for one that runs ahead.
    assert told["blow_down_nonsmooth"] == pytest.approx(1.7243769732, abs=1e-9)
    assert told["blow_up"] == pytest.approx(1.7474999087, abs=1e-9)
    assert 0 < told["share_nonsmooth"] < told["share"] < 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--velocity", "1", "0"], "`velocity` must be (low, high)"),
        (["--displacement", "nan", "0"], "`displacement` must be finite"),
        (["--belt-speed", "inf"], "`belt_speed` must be finite"),
        (["--mu-static", "0.1"], "`mu_static` must be at least"),
    ],
)
def test_a_bad_number_ends_with_2_and_is_named(asked, capsys, arguments, said):
    assert main(["basins", *arguments]) == 2
    printed = capsys.readouterr()
    assert said in printed.err
    assert printed.out == ""
    assert asked == []
