"""docs/reference/datasets.md describes every dataset: names, dimensions, units, meaning.

Sweeps are laid out by the code that lays out their stores, which runs nothing.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from drawn import made_up_modes
from layouts import PAGE, differences, row_of, rows, tables
from synthetic import cycle_branch, special_curve

from jaxchain.basins import Box, basin_shares, share_differences
from jaxchain.boundaries.equilibria import labels_of
from jaxchain.continuation import Branch
from jaxchain.model.chain import paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers import (
    Amplitude,
    Divergence,
    EnergyBalance,
    FrontTrack,
    MostSticking,
    PeakTimes,
    Samples,
    Section,
    StickTime,
)
from jaxchain.result import NAMES, message
from jaxchain.scenes.running import hopf_speed, origin_attributes
from jaxchain.sweeps.ensemble import RunSettings, prepare

SWEPT = ("belt_speed", "excited")
TABLES = tables()
DRY = paper_chain(3, width=None)
SMOOTHED = DRY.with_(width=1e-2)
# Those of dry friction together, and one that needs a width.
OBSERVERS = [
    (DRY, [Amplitude(), PeakTimes(5), Section(0, 3), Samples(1.0, 5, (0, 1)), StickTime(),
           MostSticking(), EnergyBalance(), FrontTrack(3)]),
    (SMOOTHED, [Divergence()]),
]  # fmt: skip


def laid_out(chain=DRY, observe=None, **more):
    """The dataset of a sweep of one run, with unknown values."""
    over = {"belt_speed": [1.5], "excited": [1]}
    settings = RunSettings(chain, equation_8, 100.0, observe=observe, **more)
    return prepare(settings, over, 1).sample(1)


def on_page(chapter, *sections):
    """The rows of these tables together."""
    found = {}
    for section in sections:
        found |= TABLES[chapter, section]
    return found


def test_a_sweep_with_each_observer():
    sections = {"In every sweep", "With `segments`", "With `accuracy`"}
    for chain, observers in OBSERVERS:
        own = [f"With `{type(observer).__name__}`" for observer in observers]
        sections.update(own)
        said = on_page("Sweeps", "In every sweep", *own)
        assert not differences(said, rows(laid_out(chain, observers), SWEPT))
    assert {section for chapter, section in TABLES if chapter == "Sweeps"} == sections


def test_a_sweep_in_segments_and_one_of_an_accuracy():
    cut = on_page("Sweeps", "In every sweep", "With `Amplitude`", "With `segments`")
    for name in ("amplitude", "energy", "active_count"):
        cut[name] = cut[name]._replace(dims=cut[name].dims.replace("…", "…, segment"))
    assert not differences(cut, rows(laid_out(segments=2), SWEPT))
    fitted = on_page("Sweeps", "In every sweep", "With `Amplitude`", "With `accuracy`")
    assert not differences(fitted, rows(laid_out(SMOOTHED, accuracy=1e-2), SWEPT))


def attributes(chapter, section=""):
    """The names in the first column of a table of attributes, or in its place in the prose."""
    text = PAGE.read_text(encoding="utf-8").partition(f"## {chapter}\n")[2]
    text = text.partition(f"### {section}\n")[2] if section else text
    return set(re.findall(r"`(\w+)`", re.split(r"^##", text, flags=re.MULTILINE)[0]))


def test_attributes_of_a_sweep_and_of_a_folder():
    said = attributes("Sweeps", "Attributes of a sweep")
    own = set(laid_out(SMOOTHED, accuracy=1e-2).attrs)
    assert own <= said
    more = {"wall_time_s", "devices", "device_kind", "vary", "lanes_per_device_at_end"}
    assert said - own == more
    assert set(origin_attributes()) <= attributes("Folders of results")


def test_codes():
    text = PAGE.read_text(encoding="utf-8").partition("## How runs end\n")[2].partition("##")[0]
    told = re.findall(r"^\| (\d+) \| `(\w+)` \| (.*) \|$", text, re.MULTILINE)
    wanted = [(str(k), name, message(name)) for k, name in enumerate(NAMES)]
    assert told[1:] == wanted[1:]
    assert told[0][:2] == wanted[0][:2]


@pytest.mark.long
def test_shares_and_their_differences():
    over = {"belt_speed": [1.4, 1.5]}
    shares = basin_shares(paper_chain(1, width=None), Box(), over, half_width=0.1)
    assert not differences(TABLES["Basin shares", ""], rows(shares, over))
    changes = share_differences(shares, "belt_speed")
    assert not differences(TABLES["Basin shares", "Differences of shares"], rows(changes, over))
    known = attributes("Basin shares") | attributes("Sweeps", "Attributes of a sweep")
    assert set(shares.attrs) <= known


def test_branches():
    found = {"Of cycles": cycle_branch().to_dataset()}
    zeros, none = np.zeros(2), np.zeros((2, 6))
    raw = Branch(none, zeros, zeros, np.ones((2, 7)), zeros, None, (), "max_points")
    found["Of equations"] = raw.to_dataset()
    labels = labels_of(SMOOTHED, 2, "belt_speed")
    still = replace(raw, stable=np.ones(2, bool), labels=labels)
    found["Of equilibria"] = still.to_dataset()
    found["Of complex modes"] = made_up_modes(1.0, 1.5).to_dataset()
    found["Of special points"] = special_curve().to_dataset()
    numbers = "belt_speed", "damping_ratio"
    unless = {
        "Of cycles": numbers[:1],
        "Of special points": (*numbers, *(f"special_{name}" for name in numbers)),
    }
    for section, data in found.items():
        own = rows(data, unless=unless.get(section, ()))
        assert not differences(TABLES["Branches", section], own), section
        assert set(data.attrs) <= attributes("Branches", section), section


def test_the_hopf_speed_of_a_scene():
    grid = {"belt_speed": np.ones(2), "damping_ratio": np.array([0.05])}
    found = hopf_speed(DRY, grid)
    row = row_of("hopf_belt_speed", found, ["damping_ratio"])
    assert TABLES["Folders of results", "Groups of a scene"] == {"hopf_belt_speed": row}
