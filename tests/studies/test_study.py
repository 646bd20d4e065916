"""What all studies do, on a made-up one; shared tables and pages."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from synthetic import stored

from jaxchain.model.friction import ExponentialDecay
from jaxchain.result import NAMES
from jaxchain.scenes.errors import FigureError, StudyFailedError
from jaxchain.scenes.registry import StudyTable
from jaxchain.studies._pages import letters, on_page
from jaxchain.studies._reports import ended_well, table
from jaxchain.studies._study import Study
from jaxchain.studies._tables import BaseTable, Span

TABLE = StudyTable(study="made_up", title="A title", description="More")


def one(value):
    return xr.Dataset({"speed": ("x", [value]), "result": ("x", [0]), "width": 1e-3}, {"x": [1]})


def first(table, job):
    del table
    assert not job.done
    return one(1.0)


def others(table, job):
    del table
    yield "second", one(2.0 * float(job.done["first"]["speed"][0]))
    assert list(job.done) == ["first", "second"]
    yield "third", one(3.0)


def interrupted(table, job):
    del table, job
    yield "second", one(2.0)
    raise KeyboardInterrupt


@on_page(2.0)
def page_of(page, datasets):
    panels = page.subplots(1, len(datasets), squeeze=False)
    letters(panels, "b")


def say(name, data):
    return "" if name == "second" else f"{name}: {float(data['speed'][0]):g}"


def make(more=others, **changes):
    parts = {"first": first, "more": more}
    labels = {"speed": ("front speed", "omega_n"), "x": "place"}
    return Study(parts=parts, labels=labels, report=say, figure=page_of, **changes)


def test_parts_are_described_saved_and_reported_in_order(tmp_path):
    said = []
    found = make()(TABLE, tmp_path, report=said.append)
    assert [float(data["speed"][0]) for data in found.values()] == [1.0, 2.0, 3.0]
    assert said == ["first: 1", "third: 3"]
    saved = stored(tmp_path / "made_up")
    assert saved.keys() == found.keys()
    assert all(saved[name].identical(data) for name, data in found.items())
    own = found["second"]
    assert own["speed"].attrs == {"long_name": "front speed", "units": "omega_n"}
    assert own["width"].attrs["units"] == "x0 omega_n"
    assert own["x"].attrs == {"long_name": "place"}
    assert own["result"].attrs["flag_meanings"].split() == list(NAMES)
    assert own.attrs["title"] == "A title"
    assert own.attrs["scene"] == "made_up"
    assert StudyTable.model_validate_json(own.attrs["definition"]) == TABLE
    assert (tmp_path / "made_up.png").exists()
    assert "<h1>A title</h1>" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_what_was_done_is_saved_when_a_study_is_interrupted(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        make(interrupted)(TABLE, tmp_path, report=lambda text: None)
    assert float(stored(tmp_path / "made_up")["second"]["speed"][0]) == 2.0
    assert not (tmp_path / "made_up.png").exists()
    assert (tmp_path / "report.html").exists()


def test_faults_are_raised_after_all_is_saved(tmp_path):
    def fault(datasets):
        return f"{len(datasets)} are WRONG"

    with pytest.raises(StudyFailedError, match="3 are WRONG"):
        make(fault=fault)(TABLE, tmp_path, name="made_up", report=lambda text: None)
    assert (tmp_path / "made_up.png").exists()

    def broken(datasets):
        raise ZeroDivisionError

    study = Study(parts={"first": first}, report=say, figure=broken)
    with pytest.raises(FigureError):
        study(TABLE, tmp_path / "other", report=lambda text: None)
    assert study(TABLE, tmp_path / "none", plot=False, report=lambda text: None)


def test_pages_have_letters():
    page = page_of({"a": 0, "b": 0})
    assert isinstance(page, Figure)
    np.testing.assert_allclose(page.get_size_inches(), [7.0, 2.0])
    assert [axes.get_title("left") for axes in page.axes] == ["(b)", "(c)"]


def test_tables_of_text():
    text = table({"a": ([1.0, np.nan], ".1f"), "name": (["x", "long"], "")})
    assert text.splitlines() == ["    a  name", "  1.0  x", "       long"]
    data = one(1.0)
    assert ended_well(data) == "all 1 runs ended well"
    data["result"][0] = NAMES.index("max_steps_reached")
    assert ended_well(data) == "1 of 1 runs FAILED"


def test_spans_and_chains_of_a_table():
    np.testing.assert_allclose(
        Span(start=1.0, stop=4.0, count=3, spacing="log").array(), [1.0, 2.0, 4.0]
    )
    np.testing.assert_allclose(Span(start=1.0, stop=4.0, count=3).array(), [1.0, 2.5, 4.0])
    base = BaseTable(damping_ratio=0.05, mu_static=1.0, mu_dynamic=0.5, v_ref=0.4)
    chain = base.chain(5, 1.2, width=1e-3, coupling=0.01)
    assert chain.law == ExponentialDecay(1.0, 0.5, 0.4)
    assert (chain.n, chain.belt_speed, chain.coupling) == (5, 1.2, 0.01)
    with pytest.raises(ValueError, match="mu_static: must be above"):
        BaseTable(damping_ratio=0.05, mu_static=1.0, mu_dynamic=1.0, v_ref=0.4)
