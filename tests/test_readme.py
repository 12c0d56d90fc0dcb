"""README and results pages: tables are what the stored results give; commands, links exist."""

import importlib.util
import re
import sys

import pytest


@pytest.fixture(scope="module")
def readme(repo_root):
    return (repo_root / "README.md").read_text()


def test_tables_are_the_stored_results(repo_root):
    path = repo_root / "experiments" / "tables.py"
    spec = importlib.util.spec_from_file_location("tables", path)
    tables = importlib.util.module_from_spec(spec)
    sys.modules["tables"] = tables
    spec.loader.exec_module(tables)
    blocks = 0
    for page in tables.PAGES:
        text = (repo_root / page).read_text()
        assert tables.regenerate(text) == text, "run: python experiments/tables.py"
        blocks += text.count("<!-- table:")
    assert blocks == len(tables.TABLES)


def test_commands_exist(repo_root, readme):
    for module in set(re.findall(r"python -m (mcx_jax[\w.]*)", readme)):
        assert importlib.util.find_spec(module), module
    for script in set(re.findall(r"python (experiments/\w+\.py)", readme)):
        assert (repo_root / script).is_file(), script
    targets = re.findall(r"^([a-z]+):", (repo_root / "Makefile").read_text(), re.MULTILINE)
    for target in set(re.findall(r"`?make ([a-z]+)", readme)):
        assert target in targets, target


def test_links_lead_somewhere(repo_root, readme):
    links = [x for x in re.findall(r"\]\(([^)#]+)\)", readme) if "://" not in x]
    assert len(links) >= 7  # the picture and the six files to read
    for link in links:
        assert (repo_root / link).exists(), link
