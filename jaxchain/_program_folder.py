"""Compiled programs, kept for the next process: in which folder, and which of them.

JAX writes the machine code of a program into a file named by a hash of the program, of the
versions and of the options of XLA.  It is code for the CPU that compiled it: another one of a
cluster, with the same home folder, might not know its instructions.  So each jaxlib and each kind
of CPU has a folder of its own.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import tempfile
from pathlib import Path

# What tells kinds of CPU apart, as Linux calls it on x86 and on ARM; LLVM looks at the same.
_KIND = (
    "vendor_id", "cpu family", "model", "model name", "stepping", "flags",
    "CPU implementer", "CPU variant", "CPU part", "Features",
)  # fmt: skip

# The folder that `keep_programs` has chosen; None while JAX keeps nothing, or elsewhere.
folder: str | None = None


def keep_programs(root: str | os.PathLike[str] | None) -> str | None:
    """Has JAX keep what it compiles in a folder of `root`; what is in the way, if it cannot be.

    `root`: None for `jaxchain` in the user's cache folder.  What the user has chosen otherwise, by
    the variables or the configuration of JAX, stays.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    global folder
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") is None:
        try:
            chosen = (_user_folder() if root is None else Path(root).absolute()) / _machine()
            chosen.mkdir(parents=True, exist_ok=True)
            # What may be written in says only a trial: a disk may be full, or read-only.
            tempfile.TemporaryFile(dir=chosen).close()
        except (OSError, RuntimeError) as error:  # the latter where there is no home
            return getattr(error, "strerror", None) or str(error)
        if getattr(jax.config, "jax_compilation_cache_dir") != str(chosen):  # noqa: B009
            jax.config.update("jax_compilation_cache_dir", str(chosen))
            # If something was compiled before, JAX has settled that it keeps nothing.
            compilation_cache.reset_cache()
        folder = str(chosen)
    # By itself JAX keeps what took a second: not the dozens of small programs of 20 to 60 ms.
    for name, usual, all_of_them in (
        ("jax_persistent_cache_min_compile_time_secs", 1.0, 0.0),
        ("jax_persistent_cache_min_entry_size_bytes", 0, -1),
    ):
        if name.upper() not in os.environ and getattr(jax.config, name) == usual:
            jax.config.update(name, all_of_them)
    return None


def _user_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxchain"


def _machine() -> str:
    """A name of a folder: the version of jaxlib, the machine, and a hash of its kind of CPU."""
    from jaxlib.version import __version__

    kind = hashlib.sha256(_cpu().encode()).hexdigest()[:12]
    return f"jaxlib-{__version__}-{platform.machine() or 'unknown'}-{kind}"


def _cpu() -> str:
    """All that the system tells of the kind of CPU, the same for each of its cores."""
    try:
        if platform.system() == "Darwin":
            command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout
        # Cores may differ, as the fast and the slow ones of a telephone do.
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        pairs = (line.partition(":")[::2] for line in text.splitlines())
        known = {(name.strip(), value.strip()) for name, value in pairs if name.strip() in _KIND}
        return "\n".join(map("=".join, sorted(known)))
    except (OSError, subprocess.SubprocessError):
        return platform.processor()
