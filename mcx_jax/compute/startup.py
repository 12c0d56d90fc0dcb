"""Process set-up shared by the commands: XLA flags by version, compilation cache, error lines.

Nothing here runs on import of the library; a command calls `run_command(main)` as its last line.
"""

import ctypes
import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from mcx_jax import extras
from mcx_jax.compute import jax_settings, machine, processes
from mcx_jax.console import streams
from mcx_jax.errors import UserError, reason

FUSION_FLAG = "--xla_cpu_use_fusion_emitters"
"""From jaxlib 0.8 to 0.11.1 the default CPU fusion emitters run MJX 100-300 times slower than the
older ones; from 0.11.2 the flag is gone and aborts the process. Training is faster with the default
(19 k against 15 k steps/s: tanh alone takes a ninth of the time), the environment alone slower (1.6
against 1.3 us a step)."""
DEVICES_FLAG = "--xla_force_host_platform_device_count"
PASSES_FLAG = "--xla_disable_hlo_passes"
SPLIT_PASS = "cpu-parallel-task-assigner"
"""Splits every operation over the cores; with a device per core (`sharding`) it only costs."""

M_ARENA_MAX = -8
"""glibc's name (malloc.h) for the number of heaps that its threads allocate from."""


def limit_heaps(count: int = 2) -> None:
    """Let all threads share a few heaps, unless the user has set their number; glibc alone.

    A heap for every thread is the default, and a checkpoint is written by dozens of them: the
    holes that they leave made a training run grow for twenty minutes.
    """
    said = "MALLOC_ARENA_MAX" in os.environ or "arena_max" in os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform == "linux" and not said:
        set_option = getattr(ctypes.CDLL(None), "mallopt", None)
        if set_option:
            set_option(M_ARENA_MAX, count)


def xla_flags_for(jaxlib_version: str, current: str, *, cores: int = 1, mjx: bool = False) -> str:
    """The value of XLA_FLAGS for this jaxlib, never overwriting what the user has set.

    Args:
        jaxlib_version: e.g. "0.10.2".
        current: the present value of XLA_FLAGS ("" if unset).
        cores: devices that the CPU shall count as.
        mjx: MJX will run in this process.
    """
    flags = [current] if current else []
    if mjx and FUSION_FLAG not in current and needs_old_emitters(jaxlib_version):
        flags.append(f"{FUSION_FLAG}=false")
    if cores > 1 and DEVICES_FLAG not in current and PASSES_FLAG not in current:
        flags += [f"{DEVICES_FLAG}={cores}", f"{PASSES_FLAG}={SPLIT_PASS}"]
    return " ".join(flags)


def needs_old_emitters(jaxlib_version: str) -> bool:
    """Whether MJX needs FUSION_FLAG=false with this jaxlib (and jaxlib takes it)."""
    release = tuple(
        int("".join(c for c in part if c.isdigit()) or 0) for part in jaxlib_version.split(".")[:3]
    )
    return (0, 8, 0) <= release <= (0, 11, 1)


def cache_dir() -> Path:
    """Directory of JAX's persistent compilation cache (`MCX_JAX_CACHE` overrides; "" disables)."""
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mcx_jax" / "xla"
    return Path(os.environ.get("MCX_JAX_CACHE", str(default)))


def configure(
    device: str = "auto", *, mjx: bool = False, cores: int | None = None, distributed: str = ""
) -> list[str]:
    """Set up JAX: its settings (`jax_settings`), XLA flags, the compilation cache, float32 matrix
    products, the number of heaps (`limit_heaps`); call before JAX is imported.

    Args:
        device: "auto", "cpu" or "gpu".
        mjx: MJX will run in this process.
        cores: devices that the CPU shall count as; None = all cores that this process may use.
        distributed: the other processes of this run (`mcx_jax.compute.processes.join`).

    Returns:
        What the user has to know: a line for each thing that is otherwise than usual.

    Raises:
        UserError: JAX finds no device of the kind asked for, or cannot run with a variable of the
            environment; the other processes do not come.
    """
    said = jax_settings.clean(known_flags(version("jaxlib")))
    limit_heaps()
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        cores = 1  # the user's word stands
    _set_xla_flags(machine.cores() if cores is None else cores, mjx)
    if device == "cpu":
        os.environ["JAX_PLATFORMS"] = "cpu"
        os.environ.pop("JAX_PLATFORM_NAME", None)
    try:
        import jax
    except ValueError as error:
        raise UserError(f"JAX does not start: {reason(error)}; change or unset it") from None

    # TF32 would round the policy's inputs to 10 bits: 1 mm in 1 m, the size of the errors here.
    jax.config.update("jax_default_matmul_precision", "float32")
    said += _use_cache(jax)
    processes.join(distributed)  # which JAX allows only before it has looked for devices
    _check_device(jax, device)
    return said


def known_flags(jaxlib_version: str) -> str:
    """Pattern of the XLA flags that this project sets itself, with values that XLA reads."""
    known = [
        rf"{DEVICES_FLAG}=\d+",
        rf"{PASSES_FLAG}=[\w,-]*",
        r"--xla_backend_optimization_level=\d",
    ]
    if needs_old_emitters(jaxlib_version):
        known.append(f"{FUSION_FLAG}=(true|false)")
    return "|".join(known)


def _set_xla_flags(cores: int, mjx: bool) -> None:
    current = os.environ.get("XLA_FLAGS", "")
    flags = xla_flags_for(version("jaxlib"), current, cores=cores, mjx=mjx)
    if flags != current:
        os.environ["XLA_FLAGS"] = flags


def _use_cache(jax) -> list[str]:
    """Let JAX keep compiled programs; a line for the user where it cannot."""
    if os.environ.get("MCX_JAX_CACHE") == "":
        return []
    path = ""
    try:
        path = cache_dir()
        path.mkdir(parents=True, exist_ok=True)
        with os.scandir(path) as entries, tempfile.TemporaryFile(dir=path) as file:
            next(entries, None)
            file.write(b"1")
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: nobody's home
        said = f"the cache of compiled programs {path} cannot be used ({reason(error)})"
        return [f"{said}: every start compiles; MCX_JAX_CACHE=DIR names another directory"]
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    # Of one entry that cannot be read or written: it is compiled instead.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    return []


def _check_device(jax, device: str) -> None:
    """Refuse a device that is asked for and not there; the CPU always is."""
    names = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")
    asked = {name: os.environ[name] for name in names if os.environ.get(name)}
    if device == "cpu" or (device == "auto" and set(asked.values()) <= {"cpu"}):
        return
    try:
        jax.devices("gpu" if device == "gpu" else None)
    except (AssertionError, RuntimeError):  # JAX 0.10 asserts where CUDA's plugin is missing
        said = " ".join(f"{name}={value}" for name, value in asked.items())
        if device == "gpu":
            raise UserError(
                f"--device gpu: JAX finds no GPU here{f' ({said} is set)' if said else ''}; use "
                f"--device cpu, or on a machine with one: {extras.install('cuda')}"
            ) from None
        raise UserError(
            f"{said}: JAX finds no such device here; unset it, or use --device cpu"
        ) from None


def run_command(main: Callable[[], None]) -> None:
    """Run a command's `main`: a `UserError` becomes one line on stderr and exit code 2, Ctrl-C
    ends with code 130, and output that cannot be written ends nothing (`console.streams`)."""
    streams.guard()
    try:
        main()
        streams.check()
    except UserError as error:
        streams.end_line()
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        raise SystemExit(130) from None
