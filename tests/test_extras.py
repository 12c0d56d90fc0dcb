"""Hints of missing packages: one form, and a command that works as printed."""

import importlib.metadata
import importlib.util
import os
import subprocess
import sys
import tomllib
import venv

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
    code = "import sys; sys.modules['gymnasium'] = None; import mcx_jax.integrations.gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    wanted = f"mcx_jax.integrations.gym needs gymnasium: {extras.install('gym')}"
    assert last == f"ModuleNotFoundError: {wanted}"


def installed_with(extra, repo_root):
    """Distributions that `pip install mcx_jax[extra]` brings ("" = none), by name; of the extra's
    own those that are here."""
    project = tomllib.loads((repo_root / "pyproject.toml").read_text())["project"]
    wanted = [Requirement(text) for text in project["dependencies"]]
    optional = [Requirement(text) for text in project["optional-dependencies"].get(extra, ())]
    wanted += [r for r in optional if r.name in NAMES]
    found = {}
    while wanted:
        requirement = wanted.pop()
        one = importlib.metadata.distribution(requirement.name)
        for kind in ("", *sorted(requirement.extras)):
            if (one.name, kind) in found:
                continue
            found[one.name, kind] = one
            needs = [Requirement(text) for text in one.requires or ()]
            wanted += [r for r in needs if not r.marker or r.marker.evaluate({"extra": kind})]
    return {name: one for (name, _), one in found.items()}


NAMES = {one.name for one in importlib.metadata.distributions()}


@pytest.fixture
def python_with(repo_root, tmp_path):
    """Make an environment that holds an extra and no tools of developers; returns how to run its
    Python: (words) -> the finished process. The packages are links to those installed here: no
    network is needed."""

    def make(extra):
        home = tmp_path / f"with-{extra or 'nothing'}"
        venv.create(home, symlinks=True, with_pip=False)
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        site = home / "lib" / version / "site-packages"
        for one in installed_with(extra, repo_root).values():
            tops = {file.parts[0] for file in one.files or () if file.parts[0] != ".."}
            for top in tops - {"__pycache__"}:
                if not (site / top).is_symlink():
                    (site / top).symlink_to(str(one.locate_file(top)))
        variables = {"PYTHONPATH": str(repo_root), "JAX_PLATFORMS": "cpu"}
        variables["XLA_FLAGS"] = "--xla_backend_optimization_level=0"

        def run(*words, cwd=tmp_path):
            return subprocess.run(
                [str(home / "bin" / "python"), *words],
                cwd=cwd,
                env={**os.environ, **variables},
                capture_output=True,
                text=True,
                check=False,
            )

        return run

    return make


TINY = ("--episodes", "2", "--episode-steps", "60")
GYM = """
import gymnasium, mcx_jax.integrations.gym
env = gymnasium.make("mcx_jax/V2V-v0", delay="E1")
env.reset(seed=0)
print(env.step(env.action_space.sample())[1])
"""
JOBS = {
    "": (
        ("-m", "mcx_jax"),
        ("-m", "mcx_jax.sea"),
        ("-m", "mcx_jax.train", "--smoke", "--run-dir", "run"),
        ("-m", "mcx_jax.evaluate", "run", *TINY),
        ("-m", "mcx_jax.export", "run", "--out", "policy.npz"),
        ("-m", "mcx_jax.export", "run", "--out", "policy.stablehlo"),
        ("-c", "import mcx_jax.bench.physics, mcx_jax.bench.program, mcx_jax.bench.startup_time"),
    ),
    "export": (("-m", "mcx_jax.export", "shipped:B4_4", "--out", "policy.onnx"),),
    "gym": (("-c", GYM),),
    "viz": (
        ("-m", "mcx_jax.report", "ik", *TINY, "--out", "report"),
        ("-m", "mcx_jax.train", "--smoke", "--tensorboard", "--run-dir", "run"),
        ("-c", "import mcx_jax.bench.plot, matplotlib.figure"),
    ),
    "docs": (("-m", "mkdocs", "build", "--quiet"),),
}
"""Of each extra the smallest job of every command that it is for."""


@pytest.mark.slow
@pytest.mark.parametrize("extra", JOBS)
def test_every_command_runs_without_the_tools_of_developers(
    extra, python_with, repo_root, tmp_path
):
    python = python_with(extra)
    assert python("-c", "import pytest").returncode == 1
    for words in JOBS[extra]:
        if "mkdocs" in words:  # reads the pages where they are
            done = python(*words, "--site-dir", str(tmp_path / "site"), cwd=repo_root)
        else:
            done = python(*words)
        assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
        assert "Traceback" not in done.stderr


WITHOUT = {
    "matplotlib": ("report", "ik", "--out", "report"),
    "viser": ("play", "ik"),
    "imageio[ffmpeg]": ("play", "ik", "--video", "film.mp4"),
    "pillow": ("play", "ik", "--frame", "a.png"),
    "tensorboardX": ("train", "--smoke", "--tensorboard"),
    "onnx": ("export", "shipped:B4_4", "--out", "policy.onnx"),
}


@pytest.mark.slow
def test_what_needs_an_extra_says_so_in_one_line(python_with, tmp_path):
    python = python_with("")
    before = set(tmp_path.iterdir())
    for package, (command, *words) in WITHOUT.items():
        done = python("-m", f"mcx_jax.{command}", *words)
        assert done.returncode == 2, done.stderr
        assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
        assert f" needs {package}: " in done.stderr and " install " in done.stderr
    assert set(tmp_path.iterdir()) == before
