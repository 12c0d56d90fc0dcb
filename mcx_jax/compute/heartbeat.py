"""Processes of one run tell each other that they are alive (`mcx_jax.compute.processes`).

They compute in lockstep: one that is alive but stopped, or whose network falls silent, holds up all
others, and no connection breaks. So every process says a byte to process 0 now and then, and that
one to all. Who hears nothing for too long ends, and process 0 then ends the others.
"""

import contextlib
import socket
import threading
import time
from collections.abc import Callable

ALIVE, LOST = b".", b"!"
BEAT_S = 5.0
SILENCE_S = 60.0
"""Without a word from a process: a hundred times what a busy machine delays a thread."""


class Heartbeat:
    """Speaks and listens in a thread of its own until it is stopped; a partner that closes its
    connection is no longer listened to (JAX notices that at once)."""

    def __init__(
        self,
        partners: dict[int, socket.socket],
        lost: Callable[[str], None],
        beat_s: float = BEAT_S,
        silence_s: float = SILENCE_S,
    ) -> None:
        """Starts the thread.

        Args:
            partners: {index of a process: connection to it}; they are closed in the end.
            lost: called, in the thread, with what happened.
        """
        self._partners, self._lost = dict(partners), lost
        self._beat_s, self._silence_s = beat_s, silence_s
        self._heard = dict.fromkeys(partners, time.monotonic())
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        for partner in partners.values():
            partner.setblocking(False)
        self._thread.start()

    def stop(self) -> None:
        """To be called when all processes are past their common work."""
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        while self._partners and not self._stopped.wait(self._beat_s):
            for index in list(self._partners):
                self._visit(index)
        for partner in self._partners.values():
            partner.close()

    def _visit(self, index: int) -> None:
        """Hear what a process has said meanwhile, and speak to it."""
        partner = self._partners[index]
        try:
            said = partner.recv(1024)
        except BlockingIOError:
            said = None
        except OSError:
            said = b""
        if said:
            self._heard[index] = time.monotonic()
        if said == b"":
            self._partners.pop(index).close()
        elif said and LOST in said:
            self._give_up("was told that another one is stopped or out of reach")
        elif time.monotonic() - self._heard[index] > self._silence_s:
            self._give_up(f"has heard nothing of process {index} for {self._silence_s:g} s")
        else:
            _send(partner, ALIVE)

    def _give_up(self, what: str) -> None:
        for partner in self._partners.values():
            _send(partner, LOST)
        time.sleep(2 * self._beat_s)  # a connection that closes takes with it what is not read yet
        self._stopped.set()
        self._lost(what)


def _send(partner: socket.socket, word: bytes) -> None:
    with contextlib.suppress(OSError):  # it has gone: the next look finds the connection closed
        partner.send(word)
