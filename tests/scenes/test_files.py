"""Scene files as text: found, read, and refused in words if they cannot be."""

import codecs
import time

import pytest

from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.files import MOST_BYTES, builtin_scenes
from jaxchain.scenes.reading import load_scene

TEXT = builtin_scenes()["quickstart"].read_text(encoding="utf-8")


def problem(file, content: bytes | str = TEXT, *overrides):
    """What is said of a file of this content."""
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SceneError) as error:
        load_scene(str(file), overrides)
    (found,) = error.value.problems
    assert str(error.value).isprintable() or str(error.value).count("\n") == 1
    return found


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (codecs.BOM_UTF8 + TEXT.encode(), "begins with the byte-order mark of UTF-8: save it as"),
        (TEXT.encode("utf-16"), "begins with the byte-order mark of UTF-16"),
        (b"# a\n# caf\xe9" + TEXT.encode(), "is not a text file in UTF-8: line 2 has the byte"),
        ("x = " + "[" * 5000 + "]" * 5000, "has tables or lists within each other too deep"),
        ("x = " + "{y = " * 5000 + "1" + "}" * 5000, "has tables or lists within each other too"),
        (f"a = 1\nx = {'7' * 5000}\n", "has a number of thousands of digits in line 2"),
        (f"a = 1\nb = 2\nx = 0x{'f' * 5000}\n", "has a number of thousands of digits in line 3"),
        (TEXT + "\n[experiment", "is not valid TOML: "),
    ],
)  # fmt: skip
def test_what_is_no_toml_is_refused_with_the_reason(content, said, tmp_path):
    assert problem(tmp_path / "a.toml", content).startswith(said)


def test_5000_nested_tables_are_refused_at_their_key(tmp_path):
    nested = f"{TEXT}\n[{'.'.join('a' * 5000)}]\n"
    assert problem(tmp_path / "a.toml", nested).startswith("a: is not a known key")


@pytest.mark.parametrize("name", [".toml", "...toml", "..toml", "a\nb.toml"])
def test_a_file_without_a_name_for_its_results_is_refused(name, tmp_path):
    assert "must have a name to call its results by" in problem(tmp_path / name)


def test_a_file_that_is_too_long_is_not_read(tmp_path):
    begun = time.process_time()
    found = problem(tmp_path / "a.toml", b"#" * (2 * MOST_BYTES))
    assert found.startswith("is longer than 10 MB, which no scene needs: write a range")
    assert time.process_time() - begun < 1


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("title=1\n[value]", '--set "title=1\\n[value]": '),
        ("title=1\nother=2", '--set "title=1\\nother=2": is more than one value'),
        ("a." * 5000 + "b=1", "has 5001 keys in a row, and 100 are the most"),
        ("title=" + "[" * 5000, "too deep"),
        ("title=" + "9" * 5000, "has a number of thousands of digits"),
        ("title\x1b=1", "title\\x1b"),
        ("x" * 100_000, "... (100000 characters)"),
    ],
)
def test_a_wrong_assignment_is_shown_short_and_printable(override, said, tmp_path):
    found = problem(tmp_path / "a.toml", TEXT, override)
    assert said in found
    assert len(found) < 1000
