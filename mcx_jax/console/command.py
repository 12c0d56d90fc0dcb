"""What a command (`python -m mcx_jax.NAME`) begins with, before imports that take seconds.

    if __name__ == "__main__":
        from mcx_jax.console.command import begin

        begin()

From then on Ctrl-C ends it in one line, wherever it is (a KeyboardInterrupt may come in the middle
of an import, or be swallowed by a library), and output that cannot be written does not. Nothing is
lost: whatever is on the disk survives a kill at any instant (docs/trust.md).
"""

import contextlib
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

from mcx_jax.console import streams

_words: list[Callable[[], str]] = [lambda: "stopped"]


def begin() -> None:
    """Guard the streams and take Ctrl-C, unless it is ignored (`nohup ... &`)."""
    streams.guard()
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _end)


@contextlib.contextmanager
def last_words(words: Callable[[], str]) -> Iterator[None]:
    """What Ctrl-C says inside of this, instead of "stopped"."""
    _words.append(words)
    try:
        yield
    finally:
        _words.pop()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Inside of this Ctrl-C raises KeyboardInterrupt, where there is something to tidy up."""
    before = signal.getsignal(signal.SIGINT)
    if before is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def line(name: str, *words: object) -> str:
    """A command line that works as it is printed, in any directory and without a virtual
    environment that is active.

    Args:
        name: of the command, e.g. "train".
        words: of its command line.
    """
    import shutil  # slow to import

    python = "python"
    if os.path.abspath(shutil.which(python) or "") != sys.executable:
        python = sys.executable
    return shlex.join([python, "-m", f"mcx_jax.{name}", *map(str, words)])


def _end(signum: int, frame: FrameType | None) -> None:
    del frame
    streams.say_at_once(_words[-1]())
    os._exit(128 + signum)
