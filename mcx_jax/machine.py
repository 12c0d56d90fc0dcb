"""The machine and the versions that a figure was measured with."""

import os
import sys
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "numpy")


def describe() -> str:
    """Device and versions in one line."""
    import jax

    devices = jax.devices()
    said = ", ".join(f"{name} {value}" for name, value in versions().items())
    count = jax.process_count()
    of = f" of {count} processes" if count > 1 else ""
    kind = f"{devices[0].device_kind} ({devices[0].platform})"
    return f"device: {len(devices)} x {kind}{of}; {said}"


def device() -> str:
    """The processor or GPU in words, and the number of CPU cores."""
    import jax

    found = jax.devices()[0]
    kind = cpu_name() if found.platform == "cpu" else found.device_kind
    return f"{kind}, {os.cpu_count()} CPU cores"


def cpu_name() -> str:
    """The processor's name as Linux gives it, or `cpu`."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return "cpu"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "cpu"


def versions() -> dict[str, str]:
    """Of Python and PACKAGES."""
    from importlib.metadata import version

    return {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}}
