"""What is shipped: the wheel, the pinned versions, no trace of the machine it was made on."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile

import pytest
from packaging.requirements import Requirement

# Put together here, so that this file does not contain what it looks for.
FORBIDDEN = (
    r"(?<![\w.>)])/" + r"(work|root|home|Users)/",
    r"pypi" + r"\.org",
    r"python" + r"hosted\.org",
    r"conda\.an" + r"aconda\.org",
    r"registry\.np" + r"mjs",
    r"--(extra-)?index" + r"-url",
    r"--find" + r"-links",
)


def run(*command, cwd, env=None):
    """Output of a command that must succeed; its whole text is in the failure otherwise."""
    done = subprocess.run(command, cwd=cwd, env=env, text=True, capture_output=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def project(repo_root):
    """The parsed pyproject.toml."""
    return tomllib.loads((repo_root / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def pins(repo_root):
    """Constraints as {normalised name: version}."""
    lines = (repo_root / "constraints.txt").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    for line in lines:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line), line
    return {normalised(line.split("==")[0]): line.split("==")[1] for line in lines}


@pytest.fixture(scope="module")
def tracked(repo_root):
    """Paths of the files that git tracks."""
    if not (repo_root / ".git").exists():
        pytest.skip("not a git checkout: nothing says which files belong to the project")
    names = run("git", "ls-files", "-z", cwd=repo_root).split("\0")
    return [repo_root / name for name in names if name and (repo_root / name).is_file()]


def normalised(name):
    """A distribution's name as the index compares it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("extra", ["runtime", "dev"])
def test_every_requirement_is_pinned_within_its_bounds(project, pins, extra):
    metadata = project["project"]
    wanted = (
        metadata["dependencies"] if extra == "runtime" else metadata["optional-dependencies"][extra]
    )
    for text in wanted:
        requirement = Requirement(text)
        version = pins[normalised(requirement.name)]
        assert requirement.specifier.contains(version, prereleases=True), (text, version)


def test_mujoco_and_mjx_are_pinned_as_a_pair(pins):
    assert pins["mujoco"] == pins["mujoco-mjx"]
    assert "tfp-nightly" in pins  # distrax takes whatever night it is otherwise


def test_no_machine_paths_or_registry_hosts(tracked, repo_root):
    found = []
    for path in tracked:
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # an asset
            continue
        for pattern in FORBIDDEN:
            for match in re.finditer(pattern, text):
                line = text.count("\n", 0, match.start()) + 1
                found.append(f"{path.relative_to(repo_root)}:{line}: {match.group()}")
    assert not found, "\n".join(found)


def test_ci_runs_make_test(repo_root):
    script = repo_root / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert "make test" in script.read_text(encoding="utf-8")


@pytest.mark.slow
def test_wheel_holds_the_assets_and_finds_them(repo_root, tracked, tmp_path):
    pytest.importorskip("hatchling", reason="the wheel is built with hatchling, of the dev extra")
    built = tmp_path / "dist"
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(built), cwd=repo_root)
    (wheel,) = built.glob("*.whl")
    unpacked = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    assets = repo_root / "assets"
    shipped = [path.relative_to(assets) for path in tracked if assets in path.parents]
    assert shipped
    for name in shipped:
        packed = unpacked / "mcx_jax" / "_assets" / name
        assert packed.read_bytes() == (assets / name).read_bytes(), name
    modules = [path.relative_to(repo_root) for path in tracked if path.suffix == ".py"]
    for name in (name for name in modules if name.parts[0] == "mcx_jax"):
        assert (unpacked / name).exists(), name
    assert not (unpacked / "tests").exists()
    # As installed: another folder, and the package found there, not in the source tree.
    code = (
        "from mcx_jax import assets, scene; path = assets.asset_path('ur10e_paper.xml'); "
        "print(path, scene.build_scene().nu)"
    )
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    said = run(sys.executable, "-c", code, cwd=tmp_path, env=environment)
    assert said.split() == [str(unpacked / "mcx_jax" / "_assets" / "ur10e_paper.xml"), "12"]
