"""`python -m mcx_jax.export RUN --out FILE`: a trained policy in a form that runs elsewhere.

The ending of FILE says the form. All are one control step, `observation, memory -> action, memory`,
with the normalisation inside; the interface (`mcx_jax.policy.interface`) is printed.

- `.npz`: weights by name and the interface; `mcx_jax.policy.numpy_policy` runs it with NumPy alone.
- `.onnx`: inputs `observation` (N, 38) and the memory `c`, `h` (N, H); outputs `action` (N, 6),
  `c_next`, `h_next`; the interface is the metadata property `interface`. Needs the extra `export`.
- `.stablehlo`: the same names, for JAX without mcx_jax:

      step = jax.export.deserialize(bytearray(Path("policy.stablehlo").read_bytes())).call
      out = step(observation=observation, c=c, h=h)  # {"action": ..., "c_next": ..., "h_next": ...}

  JAX promises to read such a file for six months after the release that wrote it: a form to pass
  on, not to archive.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mcx_jax import extras
from mcx_jax.config import command_line
from mcx_jax.errors import UserError, reason

if TYPE_CHECKING:
    from mcx_jax.policy.file import Policy

FORMS = (".npz", ".onnx", ".stablehlo")
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Where a .stablehlo runs: nothing in the step depends on the device."""


@dataclass(frozen=True)
class ExportConfig:
    """Write a trained policy as .npz (NumPy), .onnx or .stablehlo (JAX)."""

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """A run directory, a policy .npz file, or shipped:DELAY."""
    out: str
    """File to write; its ending says the form: .npz, .onnx or .stablehlo. Must not exist."""

    def __post_init__(self) -> None:
        path = Path(self.out)
        command_line.check_name("--out", path)
        if path.suffix not in FORMS:
            raise UserError(
                f"--out {self.out}: the ending says the form: use one of {', '.join(FORMS)}"
            )
        if path.exists():
            raise UserError(f"--out {self.out}: exists already; name another file, or remove it")
        if not path.absolute().parent.is_dir():
            raise UserError(f"--out {self.out}: no such directory")
        if path.suffix == ".onnx":
            extras.require("onnx", f"--out {self.out}")


def export(policy: "Policy", path: Path) -> None:
    """Write a policy in the form that the path's ending says; whole or not at all.

    Raises:
        UserError: the file cannot be written, or the form does not know the policy's cell.
    """
    from mcx_jax.policy.file import npz_bytes, write_whole

    if path.suffix == ".onnx":
        from mcx_jax.policy.onnx import onnx_bytes

        content = onnx_bytes(policy)
    else:
        content = npz_bytes(policy) if path.suffix == ".npz" else stablehlo_bytes(policy)
    try:
        write_whole(path, content)
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written: {reason(error)}") from None


def stablehlo_bytes(policy: "Policy") -> bytes:
    """The step as serialised StableHLO with the weights inside and a symbolic number of rows N."""
    import jax
    import jax.numpy as jnp
    from jax import export as jax_export

    from mcx_jax.policy.file import act, init_carry

    carry_like = init_carry(policy)
    structure = jax.tree.structure(carry_like)
    sizes = policy.meta.interface["state"]

    def step(observation: jax.Array, **state: jax.Array) -> dict[str, jax.Array]:
        carry = jax.tree.unflatten(structure, [state[name] for name in sizes])
        carry, action = act(policy, carry, observation)
        after = zip(sizes, jax.tree.leaves(carry), strict=True)
        return {"action": action, **{f"{name}_next": x for name, x in after}}

    (rows,) = jax_export.symbolic_shape("N")
    shapes = {"observation": policy.meta.obs_size, **sizes}
    given = {name: jax.ShapeDtypeStruct((rows, n), jnp.float32) for name, n in shapes.items()}
    return bytes(jax_export.export(jax.jit(step), platforms=PLATFORMS)(**given).serialize())


def interface_lines(policy: "Policy") -> list[str]:
    """The interface for people to read."""
    said = policy.meta.interface
    lines = [f"one step every {1000 / said['rate_hz']:g} ms; {said['frames']}"]
    lines += [f"trained for {name} {value}" for name, value in said["trained_for"].items()]
    for block in ("observation", "action"):
        for row in said[block]:
            first, last = row["index"]
            place = f"{block}[{first}..{last}]"
            lines.append(f"{place:20} {row['name']:8} {row['unit']:5} {row['meaning']}")
    lines.append(f"{'action':20} {said['action_use']}")
    sizes = ", ".join(f"{name} ({size})" for name, size in said["state"].items())
    lines.append(f"{'memory':20} {sizes}: {said['state_use']}")
    return lines


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax.compute import startup

    config = command_line.parse(ExportConfig, sys.argv[1:] if argv is None else argv, prog="export")
    for line in startup.configure("cpu"):
        print(line)
    from mcx_jax.policy.file import load_run

    policy = load_run(config.run)
    export(policy, Path(config.out))
    for line in interface_lines(policy):
        print(line)
    print(f"done: {config.out}")


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
