"""The same seed gives the same bits: twice in a process, and in a process that compiled anew."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PARTS = ("ppo", "first-order", "episodes")


@pytest.fixture(scope="module")
def processes():
    """Digests of two processes, at the same time: [{part: (seed 0, seed 0 again, seed 1)}]."""
    folder = Path(__file__).parent
    started = [
        subprocess.Popen(
            [sys.executable, "repeat.py", "1"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder.parent), "PYTHONHASHSEED": seed},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in ("1", "2")
    ]
    outputs = [process.communicate() for process in started]
    for process, (_, said) in zip(started, outputs, strict=True):
        assert process.returncode == 0, said
    return [json.loads(out.splitlines()[-1]) for out, _ in outputs]


@pytest.mark.parametrize("part", PARTS)
def test_twice_in_a_process(processes, part):
    for found in processes:
        first, again, other = found[part]
        assert first == again
        assert other != first  # the seed is used


@pytest.mark.parametrize("part", PARTS)
def test_in_another_process(processes, part):
    """Another hash seed too: no order of a set or a dictionary gets into the program."""
    assert processes[0][part] == processes[1][part]
