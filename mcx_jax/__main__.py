"""`python -m mcx_jax`: the commands, a sentence each."""

import sys

from mcx_jax import __version__
from mcx_jax.errors import UserError

COMMANDS = {
    "train": "Train an agent; show its table at the end.",
    "evaluate": "Measure a controller on fixed test episodes.",
    "play": "Show a controller: a page, a film or a picture.",
    "report": "Write one HTML page about controllers.",
    "export": "Write an agent as .npz, .onnx or .stablehlo.",
    "sea": "Compare the vessels' motion with the paper's.",
    "bench": "Measure how fast everything is on this machine.",
}
"""{module of this package: what the command does}."""


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    words = sys.argv[1:] if argv is None else argv
    if words == ["--version"]:
        print(__version__)
    elif words in ([], ["--help"], ["-h"]):
        print(f"mcx_jax {__version__}: motion compensation from vessel to vessel. Commands:\n")
        for name, sentence in COMMANDS.items():
            print(f"  python -m mcx_jax.{name:10} {sentence}")
        print("\nEach explains itself with --help.")
    elif words[0] in COMMANDS:
        raise UserError(f"{words[0]}: with a dot, python -m mcx_jax.{' '.join(words)}")
    else:
        raise UserError(
            f"{words[0]}: no such command; use python -m mcx_jax.NAME, where NAME is one of "
            f"{', '.join(COMMANDS)}"
        )


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
