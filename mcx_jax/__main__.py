"""`mcx COMMAND` or `python -m mcx_jax COMMAND`, the same as `python -m mcx_jax.COMMAND`.

Without a command it lists all of them.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import runpy
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
            print(f"  mcx {name:10} {sentence}")
        print("\nThe same: python -m mcx_jax.COMMAND. Settings: mcx COMMAND --help")
    elif words[0] in COMMANDS:
        sys.argv = [f"mcx {words[0]}", *words[1:]]
        runpy.run_module(f"mcx_jax.{words[0]}", run_name="__main__", alter_sys=True)
    else:
        raise UserError(f"{words[0]}: no such command; use one of {', '.join(COMMANDS)}")


def run() -> None:
    """The installed command `mcx`."""
    from mcx_jax.compute.startup import run_command

    run_command(main)


if __name__ == "__main__":
    run()
