"""Several processes that train one run, on one machine or on many: who writes, what is agreed on.

The programs are the same as in one process: XLA's partitioner sees the devices of all of them
(`mcx_jax.sharding`). What is left for Python: process 0 alone writes and prints, all decide alike,
and who loses a partner stops. Every process needs to see the run's directory.
"""

import contextlib
import os
import re
import socket
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcx_jax.errors import UserError, reason

PLACE = re.compile(r"(?P<coordinator>[^,\s]+:(?P<port>\d+)),(?P<index>\d+)/(?P<count>\d+)")
BROKEN = re.compile("Gloo|NCCL|UNAVAILABLE|[Cc]onnection|heartbeat")
"""What JAX's errors say when another process has gone (on a CPU they are ValueErrors)."""
WAIT_S = 120
"""For the other processes to begin."""


def check(text: str) -> None:
    """Refuse a value of --distributed that cannot be meant."""
    place = PLACE.fullmatch(text)
    meant = place and int(place["index"]) < int(place["count"]) and 0 < int(place["port"]) < 65536
    if text not in ("", "auto") and not meant:
        raise UserError(
            f"--distributed {text}: must be auto (Slurm, Open MPI or Kubernetes tell the rest) or "
            "HOST:PORT,I/N, which is process I of 0 to N - 1 and where process 0 listens "
            "(port 1 to 65535)"
        )


def join(text: str) -> None:
    """Meet the other processes; call before JAX looks for its devices. Those after the first fall
    silent on stdout. Does nothing for "".

    Args:
        text: value of --distributed.

    Raises:
        UserError: they do not come, or `auto` finds no cluster.
    """
    if not text:
        return
    import jax

    try:
        if place := PLACE.fullmatch(text):
            coordinator, count, index = place["coordinator"], place["count"], place["index"]
            meet(coordinator, int(count), int(index), WAIT_S)
            jax.distributed.initialize(coordinator, int(count), int(index))
        else:
            jax.distributed.initialize()
    except (OSError, RuntimeError, ValueError) as error:
        said = reason(error)
        raise UserError(f"--distributed {text}: the processes did not meet ({said})") from None
    if not first():
        contextlib.redirect_stdout(open(os.devnull, "w")).__enter__()  # for good


def meet(coordinator: str, count: int, index: int, wait_s: float) -> None:
    """Return when all processes have come, on the port that JAX will use: it would abort the
    process, with a stack, where one is missing.

    Raises:
        OSError: they have not all come in time, or the port cannot be used.
    """
    host, _, port = coordinator.rpartition(":")
    until = time.monotonic() + wait_s
    if index:
        while True:
            try:
                with socket.create_connection((host.strip("[]"), int(port)), wait_s) as server:
                    server.settimeout(max(until - time.monotonic(), 0.1))
                    if server.recv(1):
                        return
                raise OSError(f"process 0 at {coordinator} has given up")
            except ConnectionError:  # it is not there yet
                if time.monotonic() > until:
                    raise OSError(f"nobody listens at {coordinator} after {wait_s:g} s") from None
                time.sleep(0.2)
    with contextlib.ExitStack() as stack:
        both = socket.has_dualstack_ipv6()
        family = socket.AF_INET6 if both else socket.AF_INET
        server = stack.enter_context(
            socket.create_server(("", int(port)), family=family, dualstack_ipv6=both)
        )
        come: list[socket.socket] = []
        while len(come) < count - 1:
            server.settimeout(max(until - time.monotonic(), 0.01))
            try:
                come.append(stack.enter_context(server.accept()[0]))
            except TimeoutError:
                missing = count - 1 - len(come)
                raise OSError(f"{missing} of {count} are missing after {wait_s:g} s") from None
        server.close()
        for other in come:
            other.sendall(b"1")


def first() -> bool:
    """Whether this process writes and prints: process 0, or the only one."""
    import jax

    return jax.process_index() == 0


def alone() -> bool:
    """Whether there is one process."""
    import jax

    return jax.process_count() == 1


def agree(*numbers: int) -> tuple[int, ...]:
    """The largest of each over all processes, which all have to call this."""
    if alone():
        return numbers
    import numpy as np
    from jax.experimental import multihost_utils

    found = multihost_utils.process_allgather(np.array(numbers, np.int32))
    return tuple(int(x) for x in np.asarray(found).reshape(-1, len(numbers)).max(0))


def whole(arrays: dict[str, Any]) -> dict[str, Any]:
    """The arrays with the parts of all processes, as NumPy's; all processes have to call this."""
    import jax
    from jax.experimental import multihost_utils

    def gather(x: Any) -> Any:
        if alone() or x.is_fully_replicated:
            return jax.device_get(x)
        return multihost_utils.process_allgather(x, tiled=True)

    return {name: gather(x) for name, x in arrays.items()}


@contextlib.contextmanager
def together(path: Path) -> Iterator[None]:
    """What ends one process ends all: the others notice by a broken connection, say so in a line
    and leave with exit code 2. In one process this does nothing."""
    import jax

    try:
        yield
    except Exception as error:
        if alone():
            raise
        code, said = 2, str(error)
        if not isinstance(error, UserError):
            said = reason(error)
            if BROKEN.search(said):
                me = f"process {jax.process_index()} of {jax.process_count()}"
                said = f"{path}: {me} has lost another one; start all again with --resume ({said})"
            else:
                traceback.print_exc()
                code = 1
        print(f"error: {said}", file=sys.stderr, flush=True)
        # Not by SystemExit: on the way out JAX would wait for the others, and then abort.
        os._exit(code)


def part() -> None:
    """The end of the common work: from here on every process is on its own."""
    import jax

    if not alone():
        jax.distributed.shutdown()
