"""Stopping a training run between two iterations."""

import signal
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Self

from mcx_jax.console import streams


@dataclass
class StopRequest:
    """Turns the first SIGINT or SIGTERM into a request; the second acts as usual."""

    signum: int = 0
    previous: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> Self:
        """Install the signal handlers."""
        for signum in (signal.SIGINT, signal.SIGTERM):
            self.previous[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *exc: object) -> None:
        """Restore the previous handlers."""
        for signum, handler in self.previous.items():
            signal.signal(signum, handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        del frame
        self.signum = signum
        signal.signal(signum, self.previous[signum])
        streams.say_at_once("stopping at the end of this iteration (again: at once)")
