"""Where the data files shipped with the package lie."""

import os
from pathlib import Path

from mcx_jax.errors import UserError

_PACKAGE = Path(__file__).resolve().parent
# An installed wheel carries the files inside the package (force-include in pyproject.toml); a
# source tree keeps them beside it. The wheel's place is looked at first, so that an installed
# package never picks up a stray `assets` folder of site-packages.
_FOLDERS = (_PACKAGE / "_assets", _PACKAGE.parent / "assets")


def asset_path(name: str) -> Path:
    """Path of a shipped data file.

    Args:
        name: file name, or path below the assets folder, e.g. "vessel_hydro.npz".

    Raises:
        UserError: no such file, which means a damaged installation.
    """
    for folder in _FOLDERS:
        if (folder / name).exists():
            return folder / name
    looked = " and ".join(str(folder) for folder in _FOLDERS)
    raise UserError(
        f"asset {name!r} is missing: looked in {looked}; reinstall the package or check out assets/"
    )


SHIPPED = "shipped:"
"""`shipped:DELAY` names the trained policy for a delay that comes with the package."""


def policy_file(who: str) -> Path:
    """The policy file of `shipped:DELAY`, of a run directory, or of a file's name.

    Raises:
        UserError: no policy is shipped for that delay.
    """
    if not who.startswith(SHIPPED):
        path = Path(who)
        # os.path: False, not an error, where no file can have such a name.
        return path / "policy.npz" if os.path.isdir(path) else path
    folder = asset_path("policies")
    path = folder / f"{who.removeprefix(SHIPPED)}.npz"
    if not os.path.isfile(path):
        names = ", ".join(sorted(f"{SHIPPED}{p.stem}" for p in folder.glob("*.npz")))
        raise UserError(f"{who}: no such policy is shipped; use one of {names}")
    return path
