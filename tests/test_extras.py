"""Hints of missing packages: one form, and a command that works as printed."""

import importlib.util
import subprocess
import sys
import tomllib

import pytest
from packaging.requirements import Requirement

from mcx_jax import extras
from mcx_jax.errors import UserError


def test_the_command_is_that_of_the_readme_in_a_checkout(tmp_path, monkeypatch, repo_root):
    monkeypatch.setattr(extras, "ROOT", tmp_path)
    assert extras.install("viz") == "pip install 'mcx_jax[viz]'"  # an installed package
    (tmp_path / "constraints.txt").write_text("")
    assert extras.install("viz") == "python -m pip install -c constraints.txt -e '.[viz]'"
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    wanted = ".venv/bin/python -m pip install -c constraints.txt -e '.[viz]'"
    assert extras.install("viz") == wanted
    assert wanted in (repo_root / "README.md").read_text()


def test_every_extra_brings_the_package_that_it_is_named_for(repo_root):
    project = tomllib.loads((repo_root / "pyproject.toml").read_text())["project"]
    brought = {
        extra: {Requirement(text).name.lower() for text in texts}
        for extra, texts in project["optional-dependencies"].items()
    }
    for module, extra in extras.EXTRAS.items():
        if module != "PIL":  # comes with imageio and matplotlib
            package = extras.PACKAGES.get(module, module)
            assert Requirement(package).name.lower() in brought[extra], module


def test_what_is_missing_is_one_line(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError) as error:
        extras.require("imageio_ffmpeg", "play")
    assert str(error.value) == f"play needs imageio[ffmpeg]: {extras.install('viz')}"


def test_mcx_jax_gym_names_the_extra():
    code = "import sys; sys.modules['gymnasium'] = None; import mcx_jax.gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    wanted = f"mcx_jax.gym needs gymnasium: {extras.install('gym')}"
    assert last == f"ModuleNotFoundError: {wanted}"
