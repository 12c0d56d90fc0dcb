"""The one exception that a user's own mistake raises."""


class UserError(Exception):
    """A mistake in what the user asked for.

    The message is one line that says what is wrong, what is allowed and what to do. The commands
    print it without a traceback and exit with code 2 (`mcx_jax.startup.run_command`).
    """
