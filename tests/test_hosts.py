"""One run over two processes here: the same numbers, a common stop, the death of a partner."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax import hosts
from mcx_jax.errors import UserError
from mcx_jax.sharding import env_mesh

ITERATIONS = 100
LIMIT_S = 300


@pytest.fixture(scope="module")
def place(repo_root, tmp_path_factory):
    """(folder, environment) of the child processes, each with one device; programs are compiled
    once."""
    folder = tmp_path_factory.mktemp("hosts")
    path = os.pathsep.join([str(repo_root), str(repo_root / "tests")])
    cache = {"MCX_JAX_CACHE": str(folder / "cache"), "XLA_FLAGS": "", "PYTHONPATH": path}
    return folder, {**os.environ, **cache}


@pytest.fixture
def pair(repo_root, place):
    """Start two processes of the run of a name; the second gets a signal after an iteration."""
    folder, environment = place
    started = []

    def start(name, signum, iteration):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        for i in range(2):
            words = [str(folder / name), f"127.0.0.1:{port},{i}/2"]
            words += [str(signum), str(iteration)] if i else []
            started.append(
                subprocess.Popen(
                    [sys.executable, str(repo_root / "tests" / "two_processes.py"), *words],
                    env=environment,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
        return started[-2:]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def ends(processes):
    """(exit codes, stdouts, stderrs)"""
    said = [process.communicate(timeout=LIMIT_S) for process in processes]
    return [p.returncode for p in processes], [out for out, _ in said], [err for _, err in said]


def rows_of(run):
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def alone(repo_root, place, name):
    """A life to the end in one process of one device (`lives.py`); the run's rows."""
    folder, environment = place
    command = [sys.executable, str(repo_root / "tests" / "lives.py"), str(folder / name), "1"]
    done = subprocess.run(
        [*command, "end"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])["rows"]


def assert_alike(ours, theirs):
    """The same but for the order of sums: 1e-7 at first, which the Adam steps amplify."""
    for a, b in zip(ours, theirs, strict=True):
        for name in b.keys() - {"wall_s", "first_ratio_deviation"}:  # the latter is a rounding
            np.testing.assert_allclose(a[name], b[name], rtol=2e-3, atol=1e-4, err_msg=name)


def test_two_processes(repo_root, place, pair):
    folder, _ = place
    run, whole = folder / "both", alone(repo_root, place, "whole")

    # Stopped: the signal reaches one of them, both end after the same iteration.
    both = pair("both", signal.SIGTERM, 3)
    codes, said, errors = ends(both)
    assert codes == [128 + signal.SIGTERM] * 2, errors
    assert (
        "saved after iteration 3 of 100; go on from iteration 3 with:" in said[0]
        and "iterations of" not in said[1]
    )
    assert len(rows_of(run)) == 3
    assert_alike(rows_of(run), whole[:3])

    # Gone on with; one is killed: the other says so in a line, and what was saved is whole.
    both = pair("both", signal.SIGKILL, 8)
    codes, _, errors = ends(both)
    assert codes == [2, -signal.SIGKILL], errors
    said = [line for line in errors[0].splitlines() if line.startswith("error: ")]
    assert len(said) == 1 and "process 0 of 2 has lost another one" in said[0], errors
    assert "Traceback" not in errors[0]
    assert 7 <= len(rows_of(run)) <= 8

    # Gone on with by one process on one device, to the end.
    rows = alone(repo_root, place, "both")
    assert [row["iteration"] for row in rows] == list(range(1, ITERATIONS + 1))
    assert_alike(rows[:8], whole[:8])


@pytest.mark.parametrize(
    "text",
    [
        "here",
        "host,0/2",
        "host:1,2/2",
        "host:1,0",
        "host:1,-1/2",
        "a b:1,0/2",
        "host:1,0/0",
        "host:0,0/2",
        "host:99999,0/2",
    ],
)
def test_places_that_cannot_be_meant(text):
    with pytest.raises(UserError, match="must be auto .* or HOST:PORT,I/N"):
        hosts.check(text)
    for good in ("", "auto", "node-1.cluster:1234,0/2", "[::1]:1234,7/8"):
        hosts.check(good)


def test_a_partner_that_never_comes():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(OSError, match="1 of 2 are missing after 0.3 s"):
        hosts.meet(place, 2, 0, 0.3)
    with pytest.raises(OSError, match=f"nobody listens at {place} after 0.3 s"):
        hosts.meet(place, 2, 1, 0.3)


def test_partners_that_come_late():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    with ThreadPoolExecutor(3) as pool:
        others = [pool.submit(hosts.meet, place, 3, i, 20.0) for i in (1, 2)]
        time.sleep(0.5)
        hosts.meet(place, 3, 0, 20.0)
        for other in others:
            other.result()


def test_auto_needs_a_cluster(repo_root, place):
    command = [sys.executable, "-m", "mcx_jax.train", "--smoke", "--distributed", "auto"]
    bare = {name: value for name, value in place[1].items() if not name.startswith("SLURM")}
    done = subprocess.run(
        command, env=bare, capture_output=True, text=True, check=False, cwd=place[0]
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("error: --distributed auto: the processes did not meet (")


def test_devices_of_several_processes_must_share_evenly():
    class Device:
        def __init__(self, process_index):
            self.process_index = process_index

    with pytest.raises(UserError, match="3 devices of all processes cannot share 16 groups"):
        env_mesh(16, [Device(0), Device(0), Device(1)])


def test_one_process_agrees_with_itself():
    assert hosts.first() and hosts.alone()
    assert hosts.agree(3, 0) == (3, 0)
    found = hosts.whole({"a": jnp.arange(3)})
    assert type(found["a"]) is np.ndarray and list(found["a"]) == [0, 1, 2]
    hosts.part()
