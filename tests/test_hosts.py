"""One run over two processes here: the same numbers, a common stop, the death of a partner."""

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.compute import processes
from mcx_jax.compute.heartbeat import Heartbeat
from mcx_jax.compute.sharding import env_mesh
from mcx_jax.errors import UserError

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


@pytest.mark.slow
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
        processes.check(text)
    for good in ("", "auto", "node-1.cluster:1234,0/2", "[::1]:1234,7/8"):
        processes.check(good)


def test_a_partner_that_never_comes():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(OSError, match="1 of 2 are missing after 0.3 s"):
        processes.meet(place, 2, 0, 0.3)
    with pytest.raises(OSError, match=f"nobody listens at {place} after 0.3 s"):
        processes.meet(place, 2, 1, 0.3)


def test_partners_that_come_late():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    with ThreadPoolExecutor(3) as pool, contextlib.ExitStack() as stack:
        others = [pool.submit(processes.meet, place, 3, i, 20.0) for i in (1, 2)]
        time.sleep(0.5)
        met = processes.meet(place, 3, 0, 20.0)
        assert set(met) == {1, 2}
        for index, other in zip((1, 2), others, strict=True):
            (to_first,) = other.result().values()
            stack.enter_context(to_first)
            to_first.sendall(b"%d" % index)
            assert stack.enter_context(met[index]).recv(1) == b"%d" % index


BEAT_S, SILENCE_S = 0.02, 0.5
"""Silence in tests: 25 beats, so that a busy machine does not make one up."""


def hearts(*pairs):
    """A heartbeat for {index: socket} each; (words of those lost, heartbeats)."""
    said = [queue.Queue() for _ in pairs]
    beats = [
        Heartbeat(partners, words.put, BEAT_S, SILENCE_S)
        for partners, words in zip(pairs, said, strict=True)
    ]
    return said, beats


def test_a_process_that_falls_silent_ends_all_others():
    """Three processes; the third is alive, its connection open, and says nothing."""
    (to_1, from_0), (to_2, silent) = socket.socketpair(), socket.socketpair()
    with silent:
        said, beats = hearts({1: to_1, 2: to_2}, {0: from_0})
        assert said[0].get(timeout=20) == "has heard nothing of process 2 for 0.5 s"
        assert said[1].get(timeout=20) == "was told that another one is stopped or out of reach"
        for beat in beats:
            beat.stop()


def test_processes_that_speak_or_part_are_not_given_up():
    to_1, from_0 = socket.socketpair()
    said, beats = hearts({1: to_1}, {0: from_0})
    time.sleep(2 * SILENCE_S)
    beats[0].stop()
    time.sleep(2 * SILENCE_S)
    beats[1].stop()
    assert all(words.empty() for words in said)


@pytest.mark.slow
def test_a_stopped_process_ends_the_run_in_one_line(pair, place, monkeypatch):
    """SIGSTOP: the process is alive and its connections are open."""
    monkeypatch.setitem(place[1], "SILENCE_S", "10")
    both = pair("stopped", signal.SIGSTOP, 3)
    _, error = both[0].communicate(timeout=LIMIT_S)
    assert both[0].returncode == 2
    assert error.splitlines()[-1] == (
        "error: process 0 of 2 has heard nothing of process 1 for 10 s; start all again with "
        "--resume"
    )
    both[1].send_signal(signal.SIGCONT)
    _, error = both[1].communicate(timeout=LIMIT_S)
    assert both[1].returncode == 2 and "Traceback" not in error


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
    assert processes.first() and processes.alone()
    assert processes.agree(3, 0) == (3, 0)
    found = processes.whole({"a": jnp.arange(3)})
    assert type(found["a"]) is np.ndarray and list(found["a"]) == [0, 1, 2]
    processes.part()
