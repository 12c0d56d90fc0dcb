"""Several processes that train one run, on one machine or on many: who writes, what is agreed on.

The programs are the same as in one process: XLA's partitioner sees the devices of all of them
(`mcx_jax.compute.sharding`). In Python only this remains: process 0 writes and prints, all
processes agree on decisions, and each stops if another dies. Every process must see the run's
directory.
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

from mcx_jax.compute import heartbeat
from mcx_jax.errors import UserError, reason

PLACE = re.compile(r"(?P<coordinator>[^,\s]+:(?P<port>\d+)),(?P<index>\d+)/(?P<count>\d+)")
BROKEN = re.compile("Gloo|NCCL|UNAVAILABLE|[Cc]onnection|heartbeat")
"""What JAX's errors say when another process has gone (on a CPU they are ValueErrors)."""
WAIT_S = 120
"""For the other processes to begin."""
SILENCE_S = heartbeat.SILENCE_S
"""After which a process that says nothing is given up."""

_beats: list[heartbeat.Heartbeat] = []
"""This process's, while it works with others."""


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
            partners = meet(coordinator, int(count), int(index), WAIT_S)
            jax.distributed.initialize(coordinator, int(count), int(index))
            _beats.append(heartbeat.Heartbeat(partners, _lost, heartbeat.BEAT_S, SILENCE_S))
        else:
            jax.distributed.initialize()
    except (OSError, RuntimeError, ValueError) as error:
        said = reason(error)
        raise UserError(f"--distributed {text}: the processes did not meet ({said})") from None
    if not first():
        contextlib.redirect_stdout(open(os.devnull, "w")).__enter__()  # for good


def meet(coordinator: str, count: int, index: int, wait_s: float) -> dict[int, socket.socket]:
    """Return when all processes have come, on the port that JAX will use: it would abort the
    process, with a stack, where one is missing.

    Returns:
        {index of a process: connection to it}: process 0 has all others, these have process 0.

    Raises:
        OSError: they have not all come in time, or the port cannot be used.
    """
    until = time.monotonic() + wait_s
    host, _, port = coordinator.rpartition(":")
    if not index:
        return _wait_for(int(port), count, until, wait_s)
    while True:
        try:
            return {0: _come_to((host.strip("[]"), int(port)), index, until, wait_s)}
        except ConnectionError:  # it is not there yet
            if time.monotonic() > until:
                raise OSError(f"nobody listens at {coordinator} after {wait_s:g} s") from None
            time.sleep(0.2)
        except EOFError:
            raise OSError(f"process 0 at {coordinator} has given up") from None


def _come_to(place: tuple[str, int], index: int, until: float, wait_s: float) -> socket.socket:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_connection(place, wait_s))
        server.settimeout(max(until - time.monotonic(), 0.1))
        server.sendall(index.to_bytes(4, "big"))
        if not server.recv(1):
            raise EOFError
        stack.pop_all()  # it stays open
        return server


def _wait_for(port: int, count: int, until: float, wait_s: float) -> dict[int, socket.socket]:
    both = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if both else socket.AF_INET
    come: dict[int, socket.socket] = {}
    with (
        contextlib.ExitStack() as stack,
        socket.create_server(("", port), family=family, dualstack_ipv6=both) as server,
    ):
        while len(come) < count - 1:
            try:
                server.settimeout(max(until - time.monotonic(), 0.01))
                other = stack.enter_context(server.accept()[0])
                other.settimeout(max(until - time.monotonic(), 0.01))
                index = int.from_bytes(other.recv(4), "big")
            except TimeoutError:
                missing = count - 1 - len(come)
                raise OSError(f"{missing} of {count} are missing after {wait_s:g} s") from None
            if 0 < index < count:
                come[index] = other
            else:
                other.close()  # a stranger
        for other in come.values():
            other.sendall(b"1")
        stack.pop_all()  # they stay open
    return come


def _lost(what: str) -> None:
    """End this process: its main thread waits for the others in compiled code, for ever."""
    import jax

    me = f"process {jax.process_index()} of {jax.process_count()}"
    print(f"error: {me} {what}; start all again with --resume", file=sys.stderr, flush=True)
    os._exit(2)


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
    """Shut down the distributed runtime; from here on processes run independently."""
    import jax

    if not alone():
        jax.distributed.shutdown()  # which waits for all: until then a heart has to beat
        while _beats:
            _beats.pop().stop()
