"""Settings of JAX for jaxchain: 64 bits, all cores, small loops compiled whole."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
import warnings
from operator import attrgetter
from pathlib import Path

# Up to this size of a loop's state, in bytes, XLA's CPU compiler makes one function of the loop.
# In larger loops it starts each operation separately, at some 50 ns each. So all states count as
# small.
_EXTRA = "--xla_backend_extra_options="
_OPTION = "xla_cpu_small_while_loop_byte_threshold"
# The older emitters of what is outside loops compile a first fold in a tenth less time.
_WHOLE = f"{_OPTION}=1000000000,xla_cpu_disable_new_fusion_emitters=true"
# LLVM takes 256 bits on CPUs with instructions of 512. A jaxlib that does not know the word ends
# the process, so only those that were tried get it; the tests say whether the newest does.
_WIDTH, _TRIED = "--xla_cpu_prefer_vector_width=", (0, 12)
# Other ways to set the number of CPU devices.
_DEVICES = ("xla_force_host_platform_device_count", "JAX_NUM_CPU_DEVICES")


def configure(
    *,
    bits: int | None = 64,
    devices: int | None = None,
    whole_loops: bool = True,
    cache: bool | str | os.PathLike[str] = False,
) -> None:
    """Sets JAX up for jaxchain: call it first, before anything is computed.

    `import jaxchain` does not change JAX.  This function makes three settings:

    1. 64-bit floats, which jaxchain needs (`jax_enable_x64`);
    2. one JAX device per core (`jax_num_cpu_devices`), over which `sweep` distributes its runs;
    3. small loops compiled whole, with the widest instructions of the CPU (options of XLA, added
       to the environment variable `XLA_FLAGS`): a single run, fold or cycle takes a third of the
       time, the first one a tenth less, a batch of runs three quarters where the CPU has AVX-512,
       and results agree to rounding.  Tried with jax 0.10.2 and 0.12.0.

    Settings of the environment, or of an earlier call, take precedence.

    **Arguments:**

    - `bits`: 64, or None to keep the precision.
    - `devices`: the number of CPU devices; None: one per core that this process may use; 0: keep.
    - `whole_loops`: whether to set these options of XLA.
    - `cache`: keep compiled programs for later processes, in a folder, or with True in `jaxchain`
      in the user's cache folder (XDG_CACHE_HOME).

    With `cache`, processes share compiled programs, which give the same bits.  The folder contains
    one folder per version of jaxlib and kind of CPU.  It grows by some 20 MB in a day's work; you
    can delete it at any time.  The environment variables JAX_COMPILATION_CACHE_DIR and
    JAX_PERSISTENT_CACHE_... take precedence, and JAX_ENABLE_COMPILATION_CACHE=false switches it
    off.

    **Raises:** `ValueError` for anything else.

    **Warns:** if JAX has already computed something, so that a setting has no effect; if the given
    folder is not writable.  If the user's cache folder is not writable, nothing is kept.

    >>> import jaxchain
    >>> jaxchain.configure()
    >>> from jaxchain import hopf_belt_speed, paper_chain
    >>> round(float(hopf_belt_speed(paper_chain(belt_speed=1.0, width=1e-3))), 4)
    1.1513
    """
    if bits is not None and (isinstance(bits, bool) or bits != 64):
        raise ValueError(
            f"Argument `bits` must be 64, or None to leave it alone, but is {bits!r}."
        )
    whole = isinstance(devices, int) and not isinstance(devices, bool)
    if devices is not None and not (whole and 0 <= devices <= 10_000):
        raise ValueError(
            "Argument `devices` must be a number of devices up to 10000, None for one per core, "
            f"or 0 to leave it alone, but is {devices!r}."
        )
    if not isinstance(whole_loops, bool):
        raise ValueError(f"Argument `whole_loops` must be True or False, but is {whole_loops!r}.")
    if not isinstance(cache, bool | str | os.PathLike):
        raise ValueError(f"Argument `cache` must be a folder, True or False, but is {cache!r}.")
    import jax

    if bits:
        jax.config.update("jax_enable_x64", True)
    if cache:
        try:
            _keep_programs(_user_cache() if cache is True else Path(cache).absolute())
        except (OSError, RuntimeError) as error:  # RuntimeError if there is no home directory
            if cache is not True:
                warnings.warn(
                    f"Compiled programs cannot be kept in {os.fspath(cache)!r} (`cache`): "
                    f"{getattr(error, 'strerror', None) or error}.",
                    stacklevel=2,
                )
    late = []
    if whole_loops and not _set_whole_loops(has_computed()):
        late.append("small loops compiled whole (`whole_loops`)")
    if devices != 0 and not _set_devices(devices):
        late.append("the number of devices (`devices`)")
    if late:
        warnings.warn(
            f"JAX has computed something already, so {' and '.join(late)} could not be set: call "
            "`jaxchain.configure()` before the first computation.",
            stacklevel=2,
        )


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxchain"


def _keep_programs(root: Path) -> None:
    """Makes JAX keep compiled programs in a folder of `root` for this jaxlib and kind of CPU.

    Machine code is specific to a CPU: another computer of a cluster that shares the home folder
    may lack some of its instructions.
    """
    import jax
    from jaxlib.version import __version__

    from ._internals import forget_cache

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        kind = hashlib.sha256(_cpu().encode()).hexdigest()[:12]
        folder = root / f"jaxlib-{__version__}-{platform.machine()}-{kind}"
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # a disk may be full, or read-only
        if getattr(jax.config, "jax_compilation_cache_dir") != str(folder):  # noqa: B009
            jax.config.update("jax_compilation_cache_dir", str(folder))
            # If something was compiled before, JAX has already decided not to use a cache.
            forget_cache()
    # By default JAX keeps programs that took a second, not the dozens that take 20 to 60 ms.
    for name, usual, always in (
        ("jax_persistent_cache_min_compile_time_secs", 1.0, 0.0),
        ("jax_persistent_cache_min_entry_size_bytes", 0, -1),
    ):
        if name.upper() not in os.environ and getattr(jax.config, name) == usual:
            jax.config.update(name, always)


def _cpu() -> str:
    """Model and instructions of the CPU, the same for each of its cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        return platform.processor()
    kinds = ("model name", "flags", "CPU part", "Features")  # on x86, and on ARM
    return "\n".join(sorted({line for line in lines if line.startswith(kinds)}))


def cores() -> int:
    """The number of cores that the machine, container or job scheduler gives this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# By its name: not every version of JAX declares it.
_number_of_devices = attrgetter("jax_num_cpu_devices")


def has_computed() -> bool:
    """Whether JAX has started its devices: after that their number is fixed."""
    import jax

    now = _number_of_devices(jax.config)
    try:
        jax.config.update("jax_num_cpu_devices", 1 if now != 1 else 2)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", now)
    return False


def _set_whole_loops(computed: bool) -> bool:
    """Sets the option, unless the user set it; whether it takes effect."""
    from jaxlib.version import __version__

    words = os.environ.get("XLA_FLAGS", "").split()
    if any(_OPTION in word for word in words):
        return True
    if computed:
        return False
    # XLA reads only the last of several such words, so add to the user's word.
    last = next((i for i in reversed(range(len(words))) if words[i].startswith(_EXTRA)), None)
    if last is None:
        words.append(_EXTRA + _WHOLE)
    else:
        words[last] += f",{_WHOLE}"
    tried = tuple(map(int, __version__.split(".")[:2])) <= _TRIED
    if tried and not any(word.startswith(_WIDTH) for word in words):
        words.append(f"{_WIDTH}512")
    os.environ["XLA_FLAGS"] = " ".join(words)
    return True


def _set_devices(devices: int | None) -> bool:
    """Sets the number of devices, unless the user set it; whether it takes effect."""
    import jax

    now = _number_of_devices(jax.config)
    variables = os.environ.get("XLA_FLAGS", "") + "".join(os.environ)
    if devices is None:
        if now > 0 or any(name in variables for name in _DEVICES):
            return True
        devices = cores()
    if has_computed():
        return len(jax.devices("cpu")) == devices
    jax.config.update("jax_num_cpu_devices", devices)
    return True
