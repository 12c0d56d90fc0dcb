"""The one exception that a user's own mistake raises."""

LONGEST = 1000
"""Characters of a message; of a longer one, which quotes what it was given, the middle goes."""


def printable(text: str) -> str:
    """`text` in one line: what cannot be printed (line ends, colours, bytes of no encoding) is
    escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class UserError(Exception):
    """A mistake in what the user asked for.

    The message is one line that says what is wrong, what is allowed and what to do. The commands
    print it without a traceback and exit with code 2 (`mcx_jax.compute.startup.run_command`).
    Whatever it quotes, it stays one line: characters that cannot be printed are escaped.
    """

    def __str__(self) -> str:
        text = printable(super().__str__())
        if len(text) <= LONGEST:
            return text
        return f"{text[: LONGEST // 2]} ... {text[-LONGEST // 3 :]}"


def require(ok: bool, message: str) -> None:
    """Raise a UserError with `message` unless `ok`."""
    if not ok:
        raise UserError(message)


def reason(error: BaseException) -> str:
    """The first line of what an error says of itself, at most 300 characters; never empty."""
    text = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
    return text.splitlines()[0][:300]
