"""The machine: the cores that this process may use, and what a figure was measured with."""

import math
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
    return f"{kind}, {cores()} CPU cores"


def cores(root: Path = Path("/")) -> int:
    """CPU cores that this process may use: by affinity (where the system has that) and by the quota
    of its control group, rounded down. At least 1.

    Args:
        root: of the file system, for tests.
    """
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    return max(1, math.floor(min(count, cpu_quota(root))))


def cpu_quota(root: Path = Path("/")) -> float:
    """CPUs that Linux's control groups (version 1 or 2) grant this process, a container's limit
    say; infinite without one. A group is bound by all those around it.

    Args:
        root: of the file system, for tests.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return math.inf
    mounts, found = root / "sys/fs/cgroup", [math.inf]
    for _, controllers, group in (line.split(":", 2) for line in lines if line.count(":") > 1):
        if controllers and "cpu" not in controllers.split(","):
            continue
        for mount in (mounts, mounts / "cpu", mounts / controllers):
            inner = mount / group.lstrip("/")
            # In a container the group's name may be the host's: the mount itself is then its own.
            found += [_quota(p) for p in (inner, *inner.parents) if p.is_relative_to(mount)]
    return min(found)


def _quota(group: Path) -> float:
    try:
        if (group / "cpu.max").exists():
            quota, period = (group / "cpu.max").read_text().split()
        else:
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            quota, period = ((group / name).read_text() for name in names)
        cpus = float(quota) / float(period)
    except (OSError, ValueError):  # no such file; "max" stands for no limit
        return math.inf
    return cpus if cpus > 0 else math.inf  # -1 in version 1


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
