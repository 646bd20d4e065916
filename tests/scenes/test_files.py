"""Scene files as text: found, read, refused with a reason, and written so that they come back."""

import tomllib

import pytest

from jaxchain.scenes.files import MOST_BYTES, SceneError, builtin_scenes, read_scene, to_toml

TEXT = builtin_scenes()["quickstart"].read_text(encoding="utf-8")


def problem(file, content: bytes | str = TEXT, *overrides):
    """The problems of a file with this content."""
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SceneError) as error:
        read_scene(str(file), overrides)
    (message,) = error.value.problems
    assert str(error.value).isprintable() or str(error.value).count("\n") == 1
    return message


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("\ufeff" + TEXT, "begins with a byte-order mark: save it as UTF-8 without one"),
        (TEXT.encode("utf-16"), "is not a text file in UTF-8"),
        ("x = " + "[" * 5000 + "]" * 5000, "has tables or lists within each other too deep"),
        (f"a = 1\nb = 2\nx = 0x{'f' * 5000}\n", "has a number of thousands of digits in line 3"),
        (b"#" * (2 * MOST_BYTES), "is longer than 10 MB, which no scene needs: write a range"),
    ],
)
def test_invalid_toml_is_refused_with_the_reason(content, message, tmp_path):
    assert problem(tmp_path / "a.toml", content).startswith(message)


def test_a_file_that_does_not_exist_is_refused_with_those_that_do(tmp_path):
    for name, message in [
        ("fig33", "is neither a file nor built in (did you mean `fig3`?); built in: "),
        (str(tmp_path), "is a folder without a scene: it holds no TOML file"),
    ]:
        with pytest.raises(SceneError) as error:
            read_scene(name)
        assert error.value.problems[0].startswith(message)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("title", '--set "title": must look like path.to.key=value'),
        ("title=a b", '--set "title=a b": `a b` is not valid TOML'),
        ("title=1\nother=2", '--set "title=1\\nother=2": is more than one value'),
        ("a." * 5000 + "b=1", "has 5001 keys in a row, and 100 are the most"),
    ],
)
def test_a_wrong_assignment_is_shown_short_and_printable(override, message, tmp_path):
    error = problem(tmp_path / "a.toml", TEXT, override)
    assert message in error
    assert len(error) < 1000


TEXTS = ["a\nb", 'quotes " and \\', "\x00\x1b\x7f\u2028", "ü", "", "'''", "a\r\nb", "# no comment"]


@pytest.mark.parametrize("text", TEXTS)
def test_any_text_and_any_number_come_back(text):
    numbers = [1e-300, 1e16, 0.1 + 0.2, -0.0, 5e-324, 10**18, -3, True, False, float("inf")]
    data = {text: [text, {text: text}], "t": {"b": [], text: {"inner": numbers}}, "e": {}}
    assert repr(tomllib.loads(to_toml(data))) == repr(data)  # -0.0 and True, too
