"""What is shipped: the wheel, the pinned versions, no trace of the machine it was made on."""

import functools
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest
from packaging.requirements import Requirement

import mcx_jax
from mcx_jax import __main__ as commands
from mcx_jax.errors import UserError

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


def test_ci_installs_what_is_missing_or_says_so(repo_root, tmp_path):
    """With an apt-get and a make of our own, and a search path without a browser."""
    tools = tmp_path / "bin"
    tools.mkdir()
    scripts = {
        "apt-get": f'echo "$@" >> {tmp_path}/apt; exit "${{APT:-0}}"',
        "make": f'echo "$@" CI=$CI >> {tmp_path}/make',
        "ldconfig": "exit 0",
        "sudo": 'shift; exec "$@"',
    }
    for name, text in scripts.items():
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    for name in ("bash", "dirname", "env", "sh"):
        (tools / name).symlink_to(shutil.which(name))
    call = functools.partial(
        subprocess.run, [repo_root / ".ci" / "run"], capture_output=True, text=True, check=False
    )
    done = call(env={"PATH": str(tools)})
    assert done.returncode == 0, done.stderr
    said = (tmp_path / "apt").read_text().splitlines()
    assert said == [
        "update -qq",
        "install -y -qq --no-install-recommends chromium libosmesa6",
    ]
    assert (tmp_path / "make").read_text() == "test CI=true\n"
    refused = call(env={"PATH": str(tools), "APT": "100"})
    assert refused.returncode == 1
    assert refused.stderr.startswith("error: the tests need chromium libosmesa6 (Debian's names)")
    for name, text in {"chromium": "", "ldconfig": "echo libOSMesa.so.8"}.items():
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    assert call(env={"PATH": str(tools), "APT": "100"}).returncode == 0


def test_the_version_is_that_of_the_package():
    """`import mcx_jax` alone: quick, and without anything that is installed."""
    code = "import sys, mcx_jax; print(mcx_jax.__version__, len(sys.modules) < 100)"
    said = run(sys.executable, "-S", "-c", code, cwd=mcx_jax.__path__[0] + "/..")
    assert said.split() == [importlib.metadata.version("mcx_jax"), "True"]


def test_python_m_mcx_jax_lists_every_command(repo_root, tracked, capsys):
    package = repo_root / "mcx_jax"
    runs = [p.relative_to(package) for p in tracked if package in p.parents and p.suffix == ".py"]
    runs = [p for p in runs if "run_command(main)" in (package / p).read_text()]
    names = {str(p).removesuffix("/__main__.py").removesuffix(".py") for p in runs}
    commands.main([])
    said = capsys.readouterr().out
    assert names - {"__main__", "compute/startup"} == set(commands.COMMANDS)
    for name, sentence in commands.COMMANDS.items():
        assert sentence.endswith(".") and f"  mcx {name} " in said
    assert max(map(len, said.splitlines())) <= 80
    commands.main(["--version"])
    assert capsys.readouterr().out == f"{mcx_jax.__version__}\n"


@pytest.mark.parametrize("given", ["", "--num-envs 512", "--delay=E2 --seed 3"])
def test_make_train_gives_no_flag_twice(repo_root, given):
    """The command refuses a flag that is given twice; the Makefile has values of its own."""
    said = run("make", "-n", "train", f"ARGS={given}", cwd=repo_root)
    (line,) = [line for line in said.splitlines() if "mcx_jax.train" in line]
    assert line.count("--num-envs") == line.count("--delay") == 1
    assert line.split()[1:3] == ["-m", "mcx_jax.train"] and line.endswith(given)


def test_a_command_that_is_none_is_one_line():
    with pytest.raises(UserError, match="^fly: no such command; use one of train, evaluate, "):
        commands.main(["fly"])


def test_mcx_runs_the_command_of_that_name(repo_root):
    """As `python -m mcx_jax.evaluate`: its own error line and exit code."""
    command = [sys.executable, "-m", "mcx_jax", "evaluate", "ik", "--delay", "nonsense"]
    done = subprocess.run(command, cwd=repo_root, text=True, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ") and "nonsense" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_public_names_load_when_they_are_used():
    code = "import sys, mcx_jax; mcx_jax.configure; print('jax' in sys.modules)"
    assert run(sys.executable, "-c", code, cwd=mcx_jax.__path__[0] + "/..") == "False\n"
    for name in mcx_jax.__all__:
        assert getattr(mcx_jax, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = mcx_jax.nothing


@pytest.fixture(scope="module")
def licences(repo_root):
    """The module of tools/licences.py; the packages must be those that the page tells of."""
    path = repo_root / "tools" / "licences.py"
    spec = importlib.util.spec_from_file_location("licences", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if sys.version_info[:2] != (3, 11):
        pytest.skip("constraints.txt, and so docs/licences.md, is made with Python 3.11")
    return module


def test_licences_are_current_known_and_allowed(licences, repo_root):
    rows = licences.table()
    assert len(rows) > 40
    assert {"jax", "mujoco", "numpy", "scipy"} <= {row[0] for row in rows if row[3] == "runtime"}
    for name, version, licence, _ in rows:
        installed = importlib.metadata.version(name)
        assert installed == version, f"{name} {installed} is installed; constraints.txt: {version}"
        assert licence and licence != "UNKNOWN", f"{name} does not say its licence"
        assert not DENIED.search(licence), f"{name} is under {licence}"
    assert (repo_root / "docs" / "licences.md").read_text() == licences.page(), (
        "run: python tools/licences.py"
    )


DENIED = re.compile(r"\bA?GPL|GNU (Affero )?General|proprietary|commercial", re.IGNORECASE)


@pytest.mark.parametrize("text", ["GPL-3.0-only", "AGPL-3.0", "GNU General Public License v3"])
def test_licences_that_would_be_refused(text):
    assert DENIED.search(text) and not DENIED.search("LGPL-2.1") and not DENIED.search("MIT")


def test_installed_packages_fit_together():
    pytest.importorskip("pip", reason="this environment was made without pip")
    said = run(sys.executable, "-m", "pip", "check", "--disable-pip-version-check", cwd=".")
    assert said.strip() == "No broken requirements found."


def build_wheel(root, out, epoch):
    """Path of the wheel that hatchling builds from a source tree."""
    pytest.importorskip("hatchling", reason="the wheel is built with hatchling, of the dev extra")
    environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch}
    command = (sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out))
    run(*command, cwd=root, env=environment)
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.mark.slow
def test_wheel_is_the_same_bytes_twice(repo_root, tracked, tmp_path):
    """From the working tree and from a copy elsewhere, whose files are younger and whose rights
    differ."""
    copy = tmp_path / "copy"
    for path in tracked:
        target = copy / path.relative_to(repo_root)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
        target.chmod(0o600)
    wheels = [build_wheel(root, tmp_path / root.name, "1700000000") for root in (repo_root, copy)]
    first, second = (wheel.read_bytes() for wheel in wheels)
    assert first == second
    dated = build_wheel(copy, tmp_path / "dated", "1600000000")
    assert dated.read_bytes() != first  # the date is the one that is asked for
    with zipfile.ZipFile(dated) as archive:
        assert {entry.date_time[0] for entry in archive.infolist()} == {2020}


@pytest.mark.slow
def test_wheel_holds_the_assets_and_finds_them(repo_root, tracked, tmp_path):
    wheel = build_wheel(repo_root, tmp_path / "dist", "1700000000")
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
        "from mcx_jax import assets; from mcx_jax.play import scene; "
        "path = assets.asset_path('ur10e_paper.xml'); "
        "print(path, scene.build_scene().nu)"
    )
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    said = run(sys.executable, "-c", code, cwd=tmp_path, env=environment)
    assert said.split() == [str(unpacked / "mcx_jax" / "_assets" / "ur10e_paper.xml"), "12"]


def test_the_slurm_script_starts_25_different_agents(repo_root, tmp_path, monkeypatch):
    """With `echo` for Python: the lines that Slurm's tasks would run, parsed by the command."""
    from mcx_jax.train import read_command

    monkeypatch.chdir(tmp_path)
    runs = set()
    for task in range(25):
        said = subprocess.run(
            ["bash", str(repo_root / "tools" / "sweep.sbatch")],
            env={"SLURM_ARRAY_TASK_ID": str(task), "PYTHON": "echo", "PATH": os.environ["PATH"]},
            capture_output=True,
            text=True,
            check=True,
            cwd=tmp_path,
        ).stdout.split()
        assert said[:2] == ["-m", "mcx_jax.train"]
        command, run = read_command(said[2:])
        runs.add((command.train.env.delay, command.train.seed, str(run.path)))
    assert len(runs) == 25 and len({run for *_, run in runs}) == 25
