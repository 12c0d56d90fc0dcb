"""The site: it builds, its snippets run, and it names no flag, function or file that is not there.

Commands that compute are only parsed, but for two slow tests: the pages about own data and arms.
"""

import collections
import dataclasses
import importlib
import json
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import typing

import browser
import pytest

import mcx_jax
from mcx_jax.bench.__main__ import BenchConfig
from mcx_jax.config import command_line
from mcx_jax.config.training import preset_config
from mcx_jax.errors import UserError
from mcx_jax.evaluate import EvaluateConfig
from mcx_jax.export import ExportConfig
from mcx_jax.play.__main__ import PlayConfig
from mcx_jax.report.__main__ import ReportConfig
from mcx_jax.train import TrainCommand, smoke_config

CONFIGS = {
    "train": TrainCommand,
    "evaluate": EvaluateConfig,
    "play": PlayConfig,
    "report": ReportConfig,
    "export": ExportConfig,
    "bench": BenchConfig,
}
OTHER_FLAGS = {"--help", "--json"}
"""Of every command, and of `sea`, whose parser is no dataclass."""
LEFT_OUT = ("mcx_jax.play.", "mcx_jax.report.", "mcx_jax.bench.")
"""Packages behind one command each, of no use to others: not on the API pages."""
TINY = ["--episodes", "2", "--episode-steps", "96"]


@pytest.fixture(scope="module")
def docs(repo_root):
    return repo_root / "docs"


@pytest.fixture(scope="module")
def pages(docs):
    """Path within docs -> text."""
    return {str(p.relative_to(docs)): p.read_text() for p in sorted(docs.rglob("*.md"))}


@pytest.fixture(scope="module")
def readme(repo_root):
    return (repo_root / "README.md").read_text()


@pytest.fixture(scope="module")
def printed(repo_root):
    """tools/printed.py as a module."""
    spec = importlib.util.spec_from_file_location("printed", repo_root / "tools" / "printed.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def blocks(text, language):
    """Contents of the fenced blocks of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(text):
    """(module, words) of every `python -m mcx_jax.MODULE ...` that stands at a line's beginning."""
    found = re.findall(r"^(?:\$ )?python -m mcx_jax\.(\w+)([^\n#]*)", text, re.MULTILINE)
    return [(module, shlex.split(words)) for module, words in found]


def parse(module, words):
    """Read a command line as its command does, without running it."""
    if "--help" in words or module == "sea":
        assert set(words) <= OTHER_FLAGS, words
        return
    words = command_line.optional_value(words, "--json", "-")
    if module != "train":
        command_line.parse(CONFIGS[module], words, prog=module)
        return
    algo = command_line.value_of(words, "--algo") or "ppo"
    config = preset_config(command_line.value_of(words, "--preset") or "fast", algo)
    config = smoke_config(config) if "--smoke" in words else config
    command_line.parse(TrainCommand, words, prog=module, default=TrainCommand(train=config))


@pytest.fixture(scope="module")
def site(repo_root, tmp_path_factory):
    """Folder of the built site, which builds without a warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(
        command,
        cwd=repo_root,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    return folder


def test_the_site_fetches_nothing(site, pages):
    for page in (*pages, "readme.md"):
        html = (site / page).with_suffix(".html").read_text()
        # What a browser loads by itself: scripts, styles, pictures, not the links of a text.
        loaded = re.findall(r"<(?:script|link|img|source|iframe)\b[^>]*(?:https?:)?//[^>]*>", html)
        assert not loaded, (page, loaded)
    shown = (site / "api" / "task.html").read_text()
    assert 'id="mcx_jax.arm.lag.apply"' in shown
    assert "joint reference, rad" in shown  # units come with the arguments
    assert not list(site.rglob("*.py"))


def test_the_site_from_disk_is_whole_in_a_browser(site, tmp_path):
    """At 1280 px no table and no output is cut, numbers stay on one line; search finds."""
    with browser.tab(tmp_path / "profile", 1280) as tab:
        for page in ("index.html", "results.html", "commands.html"):
            tab.page.goto((site / page).as_uri())
            assert tab.cut_off("article :is(div, pre, code, table, img)") == [], page
            assert tab.sideways_px() <= 0 and not browser.blank(tab.picture())
        tab.page.goto((site / "results.html").as_uri())
        heights = "cells => cells.map(cell => cell.getBoundingClientRect().height)"
        rows = tab.page.locator("article table:first-of-type tbody td:nth-child(2)")
        assert max(rows.evaluate_all(heights)[:5]) < 40, "0.90 / 0.93 takes two lines"
        tab.page.goto((site / "index.html").as_uri())
        tab.page.get_by_role("link", name="README", exact=True).click()
        tab.page.wait_for_url("**/readme.html")
        tab.page.locator("input[name=query]").click()
        tab.page.keyboard.type("chatter")
        tab.page.locator(".md-search-result__item").first.wait_for(timeout=20_000)
    assert tab.complaints == []


def test_every_module_is_on_one_api_page(pages):
    shown = [
        name
        for page, text in pages.items()
        if page.startswith("api/")
        for name in re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    ]
    there = [
        module.name
        for module in pkgutil.walk_packages(mcx_jax.__path__, "mcx_jax.")
        if not module.ispkg and not module.name.endswith("__main__")
    ]
    wanted = [name for name in there if not name.startswith(LEFT_OUT)]
    assert sorted(shown) == sorted(wanted)


def test_what_the_pages_name_exists(pages):
    named = {name for text in pages.values() for name in re.findall(r"`(mcx_jax\.[\w.]+)`", text)}
    assert len(named) > 40
    for name in sorted(named):
        assert resolve(name) is not None, name


def resolve(name):
    """The module, or what it holds, of a dotted name; None if there is no such thing."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        return found
    return None


def test_every_equation_has_source_and_function(pages):
    text = pages["equations.md"]
    after = re.split(r"^```text\n.*?^```$", text, flags=re.MULTILINE | re.DOTALL)[1:]
    assert len(after) > 15
    for part in after:
        first = part.split("\n##")[0]
        assert "Source:" in first and re.search(r"`mcx_jax\.\w", first), first


def test_links_lead_somewhere(docs, pages, repo_root):
    for page, text in pages.items():
        text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        for link in re.findall(r"\]\(([^)#\s]+)", text):
            assert "://" not in link, (page, link)
            assert (docs / page).parent.joinpath(link).is_file(), (page, link)
    for path in re.findall(r"`(mcx_jax/[\w/]+\.py)`", "".join(pages.values())):
        assert (repo_root / path).is_file(), path


def test_commands_are_understood(pages, printed, readme, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # export refuses a file that is there
    texts = [*pages.values(), readme]
    # Boxes also show commands that are refused; those that compute come from their list instead.
    box = re.compile("<!-- printed:.*?<!-- end -->", re.DOTALL)
    texts = [box.sub("", text) for text in texts]
    texts += [printed.command_line(x) for x in printed.SLOW.values()]
    found = [command for text in texts for command in commands(text)]
    assert len(found) > 30
    for module, words in found:
        parse(module, words)


def test_flags_in_the_text_exist(pages):
    known = OTHER_FLAGS | {flag for config in CONFIGS.values() for flag in flags_of(config)}
    assert "--noise-mm" in known and "--target-kl" in known
    for page, text in pages.items():
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        prose = re.sub(r"`python experiments/[^`]*`", "", prose)  # scripts have their own
        for flag in re.findall(r"(?<![\w-])--(?!xla_)[a-z][a-z-]+\w", prose):
            assert flag in known, (page, flag)


def flags_of(config):
    """Every flag of a configuration and of those inside it."""
    hints = typing.get_type_hints(config)
    for field in dataclasses.fields(config):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from flags_of(hints[field.name])
        else:
            yield "--" + field.name.replace("_", "-")


PAGES_WITH_PYTHON = ("delays.md", "own-arm.md", "own-data.md")


@pytest.mark.parametrize("page", PAGES_WITH_PYTHON)
def test_snippets_run(page, pages, docs, tmp_path, monkeypatch):
    """The blocks of a page in order, as one program in an empty directory."""
    run_snippets(pages[page], docs, tmp_path, monkeypatch)


def run_snippets(text, docs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(docs)
    names = {}
    for block in blocks(text, "python"):
        exec(compile(block, "snippet", "exec"), names)
    return names


def test_no_snippet_is_left_out(pages):
    assert tuple(p for p, text in pages.items() if blocks(text, "python")) == PAGES_WITH_PYTHON


def test_the_example_log_is_what_the_page_says(pages, docs, tmp_path, monkeypatch):
    from mcx_jax.sea.recording import load_recording

    run_snippets(pages["own-data.md"], docs, tmp_path, monkeypatch)
    log = load_recording("log.csv", scale=10.0)
    authors = load_recording("motion.npy", length_unit="mm", angle_unit="deg")
    rows = min(log.knots.shape[1], authors.knots.shape[1]) - 20
    difference = abs(log.knots - log.knots.mean(axis=1, keepdims=True))[:, :rows, :6]
    assert difference.max() > 0.05  # it moves
    # Two samplings of one motion, linear at 100 Hz: (w h)^2 / 8 of 0.1 m at 3 rad/s, and the means.
    assert abs(log.knots - authors.knots)[:, 10:rows, :6].max() < 1e-3


def test_printed_files_are_of_the_commands(pages, printed, readme):
    every = printed.QUICK | printed.SLOW
    text = "".join([*pages.values(), readme])
    boxes = re.findall(r"^<!-- printed: (.*) -->$", text, re.MULTILINE)
    assert {name.partition(":")[0] for box in boxes for name in box.split()} == set(every)
    assert {p.stem for p in printed.FOLDER.glob("*.txt")} == set(every)
    for name, command in every.items():
        first, *_, last = (printed.FOLDER / f"{name}.txt").read_text().splitlines()
        assert first == f"$ {printed.command_line(command)}", name
        assert (name in printed.QUICK) or re.fullmatch(r"# commit \w+, .*", last), name


def test_pages_hold_the_stored_output(pages, printed, readme):
    for page, text in {**pages, "README.md": readme}.items():
        assert printed.filled(text) == text, f"{page}: run: python tools/printed.py pages"
    assert "--8<--" not in "".join(pages.values())


def test_help_and_refusals_are_what_is_printed_today(printed, repo_root, monkeypatch, capsys):
    monkeypatch.chdir(repo_root)
    monkeypatch.setenv("COLUMNS", printed.COLUMNS)
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))  # a command sets it: put back
    for name, command in printed.QUICK.items():
        stored = (printed.FOLDER / f"{name}.txt").read_text().split("\n", 1)[1]
        said = printed.tidied(said_here(command, monkeypatch, capsys))
        assert words_of(said) == words_of(stored), f"stale: python tools/printed.py {name}"


def words_of(text):
    """Words and how often each; captured, tyro draws no boxes and wraps its columns elsewhere."""
    return collections.Counter(re.findall(r"\w[\w.:]*", text))


def said_here(command, monkeypatch, capsys):
    """What a command says that ends at once, in this process."""
    module, *words = shlex.split(command)
    package = importlib.import_module(f"mcx_jax.{module}")
    if not hasattr(package, "main"):
        package = importlib.import_module(f"mcx_jax.{module}.__main__")
    monkeypatch.setattr(sys, "argv", [module, *words])
    capsys.readouterr()
    try:
        package.main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
    except SystemExit as stop:
        assert not stop.code
    return "".join(capsys.readouterr())


def test_refusals_of_arms_are_all_told(pages):
    from mcx_jax.arm.fields import REFUSED

    told = pages["own-arm.md"].replace("`", "")
    for refusal in REFUSED:
        assert f"| {refusal.fault} |" in told, refusal.fault


def test_the_example_arm_is_taken(docs):
    from mcx_jax.arm.model import chain_model, load_mujoco

    model = chain_model(load_mujoco(str(docs / "seven.xml")), "gripper")
    assert model.nq == 7 and model.integrator == "implicitfast"


def run(folder, root, *words):
    """Run a command in a folder; it must succeed."""
    quick = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0".strip()
    variables = {"PYTHONPATH": str(root), "XLA_FLAGS": quick}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.slow
def test_own_data_from_log_to_report(pages, docs, repo_root, tmp_path, monkeypatch):
    run_snippets(pages["own-data.md"], docs, tmp_path, monkeypatch)
    tiny = {"train": ["--smoke"], "export": []}
    done = []
    for module, words in commands(pages["own-data.md"]):
        said = run(tmp_path, repo_root, "-m", f"mcx_jax.{module}", *words, *tiny.get(module, TINY))
        assert "done: " in said or "tracking error" in said, said
        done.append(module)
    assert done == ["evaluate", "train", "evaluate", "report", "export", "evaluate"]
    assert {p.name for p in tmp_path.iterdir()} >= {"runs", "report", "policy.npz"}
    assert (tmp_path / "report" / "index.html").is_file()


@pytest.mark.slow
def test_own_arm_tracks(pages, docs, repo_root, tmp_path, monkeypatch):
    (tmp_path / "docs").symlink_to(docs)
    module, words = commands(pages["own-arm.md"])[0]
    words += ["--episodes", "8", "--json", "rows.json"]
    run(tmp_path, repo_root, "-m", f"mcx_jax.{module}", *words)
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [row["sea"] for row in rows] == ["Wa", "Wb", "Wc", "Wd"]
    assert all(row["invalid_episodes"] == 0 for row in rows)
    # Printed on the page: 1.3 to 2.3 mm, 1.9 to 2.2 mrad, of 50 episodes.
    assert all(row["pos_mm"]["mean"] < 3 and row["ang_mrad"]["mean"] < 3 for row in rows)


@pytest.mark.slow
def test_the_spare_joint_stays_near(pages, docs, tmp_path, monkeypatch):
    names = run_snippets(pages["own-arm.md"], docs, tmp_path, monkeypatch)
    mean_rad, largest_rad = names["third_joint"](names["EPISODES"], names["STEPS"])
    assert round(mean_rad, 2) == 0.06 and abs(largest_rad - 0.45) < 0.02  # as the page says
