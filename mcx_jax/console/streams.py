"""Standard output and error that cannot end a command: closed, full or gone, the work goes on.

`guard` puts a `Guarded` stream in the place of both, through which print, rich, tyro, warnings,
logging and tracebacks write. A stream that fails is tried again at the next write (a disk may have
room again); the first error is kept, for `take_losses` (a run's messages.log) or `check`.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any, TextIO, cast

from mcx_jax.errors import UserError, reason

NAMES = {"stdout": "standard output", "stderr": "standard error"}
CLOSED = "it was closed from the start"
GONE = (CLOSED, os.strerror(errno.EPIPE))
"""Losses that somebody has asked for: nobody listens (`>&-`, or `| head` has read enough)."""


class Guarded:
    """A text stream whose writing never raises OSError."""

    def __init__(self, stream: TextIO | None, name: str) -> None:
        """Guard a stream.

        Args:
            stream: None = the process was started without it.
            name: in messages.
        """
        self.name = name
        self.error = "" if stream else CLOSED
        """The first error's reason; "" = none yet."""
        self.taken = False
        """Whether `take_losses` has reported it."""
        self.mid_line = False
        """Whether the last line that was written has no end yet."""
        self._stream = stream or open(os.devnull, "w")
        if getattr(self._stream, "errors", "") == "strict":  # a character that it cannot encode
            cast(Any, self._stream).reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        """Everything else is the stream's own."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or note that it was not possible."""
        if text:
            self.mid_line = not text.endswith("\n")
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Pass on what is buffered, or note that it was not possible."""
        self._attempt(self._stream.flush)

    def isatty(self) -> bool:
        """Whether it is a terminal; False for one that is gone."""
        return bool(self._attempt(self._stream.isatty))

    def _attempt(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except (OSError, ValueError) as error:  # ValueError: closed by somebody in this process
            self.error = self.error or reason(error)


def guard() -> None:
    """Guard standard output and error for the rest of the process; again: nothing."""
    _occupy_closed()
    for name, words in NAMES.items():
        stream = getattr(sys, name)
        if not isinstance(stream, Guarded):
            setattr(sys, name, Guarded(stream, words))


def _occupy_closed() -> None:
    """Open the null device as each of 0, 1 and 2 that is closed: the next file to be opened would
    get that number, and what libraries in C print."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number: this one


def take_losses() -> list[str]:
    """A line for each of the streams that has failed since the last call."""
    lines = []
    for stream in _guarded():
        stream.flush()
        if stream.error and not stream.taken:
            stream.taken = True
            lines.append(f"{stream.name} cannot be written ({stream.error}); the work goes on")
    return lines


def check() -> None:
    """Refuse to end well with a standard output that was lost and is reported nowhere.

    Raises:
        UserError: it was lost, and not because nobody reads it.
    """
    stream = sys.stdout
    if not isinstance(stream, Guarded):
        return
    stream.flush()
    if stream.error and not stream.taken and stream.error not in GONE:
        raise UserError(
            f"{stream.name} cannot be written ({stream.error}); all else was done; write to "
            "another place"
        )


def end_line() -> None:
    """End a line of progress that is drawn in place, before something else is printed."""
    for stream in _guarded():
        if stream.mid_line:
            stream.write("\n")
            stream.flush()


def say_at_once(text: str) -> None:
    """Print a line on standard error from a signal handler, which may have interrupted a print."""
    with contextlib.suppress(RuntimeError):  # a reentrant call
        sys.stdout.flush()
    with contextlib.suppress(OSError):
        os.write(2, f"\n{text}\n".encode(errors="backslashreplace"))


def _guarded() -> list[Guarded]:
    return [s for s in (sys.stdout, sys.stderr) if isinstance(s, Guarded)]
