import pytest

from jaxchain.model.measured import read_curve


def written(folder, text):
    file = folder / "mu.csv"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(
    "text",
    [
        "0,1.0\n0.5,0.7\n2,0.5\n",
        "# rig 2\n\nspeed;mu\n0;1.0\n0.5;0.7  # worn\n\n2;0.5\n",
        "\ufeff0 1.0\n0.5\t0.7\n2  0.5\n",
    ],
)
def test_two_columns_are_read_as_people_write_them(tmp_path, text):
    assert read_curve(written(tmp_path, text)) == ([0.0, 0.5, 2.0], [1.0, 0.7, 0.5])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("0,1\n0.5\n", "line 2 of .* must be two numbers, .* but is '0.5'"),
        ("s,mu\n0,1\n1,half\n", "line 3 .* but is '1,half'"),
        ("s,mu\nm/s,-\n0,1\n", "line 2"),
    ],
)
def test_a_line_that_is_no_pair_of_numbers_is_named(tmp_path, text, line):
    with pytest.raises(ValueError, match=line):
        read_curve(written(tmp_path, text))
