"""Whatever a study saves in a test is as docs/reference/datasets.md says."""

import json

import pytest
from layouts import differences, rows, section_of, tables

from jaxchain.scenes.registry import studies
from jaxchain.scenes.storage import Results


@pytest.fixture(autouse=True, scope="session")
def as_the_page_says():
    save, said = Results.save, tables()

    def checked(self, name, data):
        study = json.loads(data.attrs.get("definition", "{}")).get("study")
        # Studies that a test makes up stand on no page.
        if study in studies():
            told = differences(said[section_of(study, name)], rows(data))
            assert not told, f"docs/reference/datasets.md, {study}, {name}: " + "\n".join(told)
        save(self, name, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Results, "save", checked)
        yield
