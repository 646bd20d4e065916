"""Examples in help, completion in a shell, and Ctrl-C in a process of its own."""

import argparse
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

import pytest

from jaxchain.cli import _parser, main
from jaxchain.scenes import load_scene


def subcommands():
    parser = _parser()
    (choices,) = (one.choices for one in parser._actions if isinstance(one.choices, dict))
    return {"": parser, **choices}


@pytest.mark.parametrize("name", subcommands())
def test_a_subcommand_shows_examples_of_its_own_that_can_be_typed(name, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda package: package)
    text = subcommands()[name].format_help()
    examples = text.partition("examples:\n")[2].partition("\n\n")[0].splitlines()
    assert examples
    for line in examples:
        words = shlex.split(re.split(r"\s{2,}", line.strip())[0])
        assert words.pop(0) == "jaxchain"
        assert words[0] in subcommands() or words[0] == "COMMAND"
        assert not name or words[0] == name
        if words[0] == "COMMAND":
            continue
        options = _parser().parse_args(words[: words.index(">")] if ">" in words else words)
        if getattr(options, "set", None):
            load_scene(options.scene, options.set)


def completed(script, *words):
    """What bash offers after these words, the last of which is being typed."""
    line = shlex.join(words)
    program = (
        f"source {shlex.quote(str(script))}\nCOMP_WORDS=({line})\nCOMP_CWORD={len(words) - 1}\n"
        'compopt() { :; }\n_shtab_jaxchain\nprintf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(
        ["bash", "-c", program], capture_output=True, text=True, cwd=script.parent
    )
    assert not done.stderr
    return {*done.stdout.split()}


def test_bash_completes_subcommands_options_scenes_and_files(tmp_path, capsys):
    if shutil.which("bash") is None:
        pytest.skip("there is no bash here")
    with pytest.raises(SystemExit) as ended:
        main(["--completion", "bash"])
    assert ended.value.code == 0
    script = tmp_path / "completion"
    script.write_text(capsys.readouterr().out, encoding="utf-8")
    (tmp_path / "my.toml").touch()
    (tmp_path / "results").mkdir()
    assert completed(script, "jaxchain", "b") == {"boundary", "basins"}
    assert completed(script, "jaxchain", "boundary", "--mu") == {"--mu-static", "--mu-dynamic"}
    assert completed(script, "jaxchain", "run", "quick") == {"quickstart"}
    assert completed(script, "jaxchain", "run", "my") == {"my.toml"}
    assert completed(script, "jaxchain", "resume", "") == {"results"}


# A process that gets the signal of Ctrl-C in the import of a module of this name.
INTERRUPTED = """
import os, signal, sys

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupts())
from jaxchain.cli import main
sys.exit(main(["boundary"]))
"""


@pytest.mark.parametrize("module", ["numpy._core.numeric", "jaxchain.boundaries"])
def test_ctrl_c_while_packages_are_imported_prints_one_line(module):
    command = [sys.executable, "-c", INTERRUPTED, module]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "jaxchain: interrupted\n")


class Reporting:
    """An object whose end raises, as a callback of the garbage collector may."""

    def __init__(self, raises):
        self.raises = raises

    def __del__(self):
        self.raises()


def test_ctrl_c_in_a_callback_is_not_lost_and_other_errors_are_reported(monkeypatch, capsys):
    reported, ends = [], []

    def wrong():
        raise ValueError("wrong")

    def command(options):
        Reporting(wrong)
        Reporting(lambda: signal.raise_signal(signal.SIGINT))
        time.sleep(20.0)
        ends.append("not interrupted")

    monkeypatch.setattr("sys.unraisablehook", lambda one: reported.append(one.exc_type))
    monkeypatch.setattr("jaxchain.cli._parser", argparse.ArgumentParser)
    monkeypatch.setattr(
        argparse.ArgumentParser, "parse_args", lambda *words: argparse.Namespace(command=command)
    )
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main([]) == 130
    finally:
        signal.signal(signal.SIGINT, usual)
    assert (reported, ends) == ([ValueError], [])
    assert capsys.readouterr().err == "jaxchain: interrupted\n"
