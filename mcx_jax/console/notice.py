"""Lines that a user should read, from code that many commands share."""

import contextlib
import functools
import sys


@functools.cache
def notice(line: str) -> None:
    """Print a line to standard error, once in a process; where nobody listens, in silence.

    Not to standard output, which `--json -` fills.
    """
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):  # closed, or a full disk behind it
            print(line, file=sys.stderr, flush=True)
