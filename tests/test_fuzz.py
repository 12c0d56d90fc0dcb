"""Whatever a user may give: a result, or one line that says what is wrong. Never another exception,
never a hang, never a file left behind. The same cases in every run; what was found once is an
`example`."""

import collections
import contextlib
import dataclasses
import io
import json
import os
import signal
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import get_type_hints

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mcx_jax import evaluate, export, extras, train
from mcx_jax.arm.load import load_arm
from mcx_jax.arm.model import ARMS, load_mujoco
from mcx_jax.bench import __main__ as bench_command
from mcx_jax.compute import startup
from mcx_jax.config import command_line
from mcx_jax.config.delay import parse_delay
from mcx_jax.config.task import EnvConfig, parse_range
from mcx_jax.config.training import TrainConfig, preset_config
from mcx_jax.envs.goal_path import load_goal_path
from mcx_jax.errors import UserError
from mcx_jax.play import __main__ as play_command
from mcx_jax.policy.file import Policy, PolicyMeta, load_policy, npz_bytes
from mcx_jax.policy.networks import init_params
from mcx_jax.policy.normalise import init_stats
from mcx_jax.report import __main__ as report_command
from mcx_jax.report.entries import learning_curves
from mcx_jax.runs import checkpoint
from mcx_jax.runs.run_dir import METRICS, _cut_metrics, stored_config
from mcx_jax.sea import __main__ as sea_command
from mcx_jax.sea.recording import load_recording
from mcx_jax.sea.spectrum import parse_sea

HANG_S = 60
"""A case takes milliseconds; nothing is measured, a case that never ends is ended."""


def cases(count: int):
    """`count` cases that are the same in every run."""
    return settings(
        max_examples=count,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


OUTCOMES: collections.Counter[tuple[str, bool]] = collections.Counter()
"""How many cases of each test were taken, and how many refused."""


class Reached(Exception):
    """A command has read and checked all that it was given and would start to compute."""


class Hang(BaseException):
    pass


def _hang(signum, frame):
    raise Hang(f"not done after {HANG_S} s")


def sober(call, *args, where: Path | None = None):
    """The result of a call; None where it was refused, in one line, leaving `where` as it was."""
    test = os.environ["PYTEST_CURRENT_TEST"].split("::")[1].split()[0]
    before = _listing(where)
    old = signal.signal(signal.SIGALRM, _hang)
    signal.alarm(HANG_S)
    try:
        result = call(*args)
        OUTCOMES[test, True] += 1
        return result
    except UserError as error:
        OUTCOMES[test, False] += 1
        assert str(error).strip() and "\n" not in str(error), repr(str(error))
        assert len(str(error)) <= 1000
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
        assert _listing(where) == before
    return None


def _listing(where: Path | None):
    if where is None:
        return None
    return sorted((str(p), p.stat().st_size) for p in where.rglob("*"))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A working directory for the whole file; MuJoCo and others write into it."""
    folder = tmp_path_factory.mktemp("fuzz")
    with contextlib.chdir(folder):
        yield folder


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


# --- what strange values look like ---

LONG = "x" * 5000
DIGITS = "9" * 5000
NUMBERS = st.one_of(
    st.integers(-(10**40), 10**40).map(str),
    st.floats().map(repr),
    st.sampled_from(["nan", "inf", "-inf", "1e999", "-0", "0", "1", "1_000", "٣", "0x10", DIGITS]),
)
WORDS = st.one_of(
    NUMBERS,
    st.text(st.characters(exclude_characters="\0"), max_size=20),
    st.sampled_from(["", " ", "-", "--", "=", ".", "..", "/", "~", LONG, "\n", "\udcff", "a/b/c"]),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@st.composite
def damaged(draw, content: bytes):
    """Bytes that were something good: cut, bits flipped, overwritten, doubled."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        match draw(st.sampled_from(["flip", "cut", "insert", "byte", "drop"])):
            case "flip" if data:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "byte" if data:
                data[at] = draw(st.integers(0, 255))
            case "cut":
                del data[at:]
            case "drop":
                del data[at : at + draw(st.integers(1, 40))]
            case "insert":
                data[at:at] = draw(st.binary(max_size=20))
    return bytes(data)


@st.composite
def changed_json(draw, values):
    """A copy of some JSON with one entry, at any depth, replaced, removed, renamed or added."""
    values = json.loads(json.dumps(values))
    inside = values
    while True:
        nested = [k for k, v in inside.items() if isinstance(v, dict) and v]
        if not nested or not draw(st.booleans()):
            break
        inside = inside[draw(st.sampled_from(nested))]
    key = draw(st.sampled_from(sorted(inside)))
    match draw(st.sampled_from(["replace", "number", "remove", "rename", "add"])):
        case "replace":
            inside[key] = draw(JSON)
        case "number":
            inside[key] = draw(
                st.sampled_from([-1, 0, 1.5, 1e308, 10**400, -(2**63), 2**31, 2**64])
            )
        case "remove":
            del inside[key]
        case "rename":
            inside[draw(st.text(max_size=5))] = inside.pop(key)
        case "add":
            inside[draw(st.text(max_size=5))] = draw(JSON)
    return values


DEEP = b"[" * 100_000
"""JSON that is nested too deeply for the parser."""


# --- strings in settings ---

DELAYS = st.one_of(
    WORDS,
    st.builds("E{}".format, WORDS),
    st.builds("butter:{}:{}Hz".format, NUMBERS, NUMBERS),
    st.builds("butter:{}:{:f}".format, st.integers(-1, 14), st.floats(0, 26)),
    st.lists(st.sampled_from(["E0", "E1", "B4_4", "explicit:3", "butter:2:5Hz", "b4_4"])).map(
        ",".join
    ),
)


@cases(500)
@given(DELAYS)
@example("E" + DIGITS)
@example(f"butter:{DIGITS}:5Hz")
@example(f"butter:4:{DIGITS}Hz")
@example("E٣")
def test_delays(text):
    config = sober(lambda: EnvConfig(delay=text))
    delay = sober(parse_delay, text)
    for found in config.delays if config else [delay] if delay else []:
        assert 0 <= found.group_delay_s <= 1.0 and found.describe()


@cases(400)
@given(
    st.sampled_from([("--noise-mm", 1e3, False), ("--latency-steps", 50, True)]),
    st.one_of(WORDS, st.builds("{}:{}".format, NUMBERS, NUMBERS), st.builds("{}:".format, NUMBERS)),
)
def test_ranges(kind, text):
    flag, limit, whole = kind
    found = sober(parse_range, flag, text, limit, whole)
    if found:
        assert 0 <= found.low <= found.high <= limit


@cases(200)
@given(st.one_of(WORDS, st.builds("{}:{}".format, NUMBERS, NUMBERS)))
@example("1e-320:4")
def test_seas(text):
    sea = sober(parse_sea, text)
    if sea:
        assert 0 < sea.hs_m < 100 and 3 <= sea.tp_s <= 20


# --- command lines ---


def flags_of(kind) -> list[str]:
    """Flags of a configuration, nested ones flat."""
    found = []
    for field in dataclasses.fields(kind):
        hint = get_type_hints(kind)[field.name]
        flag = "--" + field.name.replace("_", "-")
        found += flags_of(hint) if dataclasses.is_dataclass(hint) else [flag]
    return found


COMMANDS = {
    "train": (train.main, [], flags_of(train.TrainCommand)),
    "evaluate": (evaluate.main, ["ik"], flags_of(evaluate.EvaluateConfig)),
    "report": (report_command.main, ["ik", "--out", "new"], flags_of(report_command.ReportConfig)),
    "export": (export.main, ["ik", "--out", "new.npz"], flags_of(export.ExportConfig)),
    "play": (play_command.main, ["ik"], flags_of(play_command.PlayConfig)),
    "bench": (bench_command.main, [], flags_of(bench_command.BenchConfig)),
    "sea": (sea_command.main, [], ["--json"]),
}
GOOD = st.sampled_from(
    ["ik", "fir", "E1", "B4_4", "1", "0", "64", "0.5", "Wa", "paper", "chain", "fast", "cpu",
     "out.json", "out.npz", "out.png", "out.mp4", "euler", "seeds", "1:2", "static", "first-order"]
)  # fmt: skip


@st.composite
def command_lines(draw, good: list[str], flags: list[str]):
    """A good command line, or some words, and then flags with values of any kind, cut short or
    misspelt."""
    argv = draw(st.one_of(st.just(good), st.lists(st.one_of(GOOD, WORDS), max_size=2))).copy()
    for _ in range(draw(st.integers(0, 4))):
        flag = draw(st.sampled_from(flags))
        if draw(st.integers(0, 9)) == 0:
            flag = draw(st.sampled_from([flag[:-1], flag + "s", flag.upper(), flag[1:], "--help="]))
        value = draw(st.one_of(GOOD, GOOD, WORDS))
        match draw(st.integers(0, 5)):
            case 0:
                argv.append(flag)
            case 1:
                argv.append(f"{flag}={value}")
            case _:
                argv += [flag, value]
    return argv


@pytest.mark.parametrize("name", COMMANDS)
def test_command_lines(name, place, monkeypatch, capsys):
    """Everything that a command reads and checks before it starts to compute."""
    main, good, flags = COMMANDS[name]

    def reached(*args, **kwargs):
        raise Reached

    monkeypatch.setattr(startup, "configure", reached)
    monkeypatch.setattr(sea_command, "build_tables", reached)
    # Without the extra viz, which CI has not, every line for `play` would be refused at the door.
    monkeypatch.setattr(extras, "require", lambda module, what: None)
    monkeypatch.setattr(tempfile, "tempdir", str(place))

    @cases(70)
    @given(command_lines(good, flags))
    @example(["--run-dir", LONG])
    @example(["ik", "--json", LONG])
    @example([LONG, "--out", LONG + ".npz"])
    @example(["ik", "--out", LONG])
    @example(["ik", "--seed", str(10**30)])
    @example(["ik", "--video", LONG + ".mp4"])
    @example(["ik", "--device", "tpu"])
    def check(argv):
        def run():
            try:
                main(argv)
            except Reached:
                return True
            except SystemExit as stop:
                assert stop.code == 0 and any(w in ("-h", "--help") for w in argv), argv
            return False

        sober(run, where=place)

    check()
    capsys.readouterr()


# --- files ---

TABLES = st.one_of(
    st.binary(max_size=200),
    st.text(max_size=100).map(lambda text: text.encode("utf-8", "surrogatepass")),
    st.lists(
        st.lists(st.one_of(NUMBERS, st.just(""), st.floats(0, 9).map(str)), min_size=3, max_size=8),
        max_size=6,
    ).flatmap(
        lambda rows: st.sampled_from([",", ";", "\t", ", ", " ", "|"]).map(
            lambda mark: "\n".join(mark.join(row) for row in rows).encode()
        )
    ),
)


@st.composite
def number_tables(draw, columns: int, rows: int):
    """A good table with some strange numbers and a column too many or too few now and then."""
    columns += draw(st.sampled_from([0, 0, 0, 0, -1, 1]))
    rows = draw(st.sampled_from([0, 1, 2, rows, rows]))
    step_s = draw(st.sampled_from([0.1, 0.1, 0.1, 1e-3, 1e3, 0.0, -0.1, 1e300, 5e-324]))
    data = np.zeros((rows, columns))
    data[:, 0] = step_s * np.arange(rows)
    for _ in range(draw(st.integers(0, 3)) if data.size else 0):
        row, column = draw(st.integers(0, rows - 1)), draw(st.integers(0, columns - 1))
        data[row, column] = draw(st.floats())
    if draw(st.booleans()) and data.size:
        data[:, draw(st.integers(0, columns - 1))] += draw(st.floats())
    return data


def csv(data: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savetxt(file, data, delimiter=",")
    return file.getvalue()


def npy(data: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, data, allow_pickle=True)
    return file.getvalue()


@cases(250)
@given(content=st.one_of(TABLES, number_tables(4, 20).map(csv)))
@example(content=b"0,0,0,0\n1,1e300,0,0\n")
@example(content=b"-1e308,0,0,0\n1e308,0,0,0\n")
def test_goal_files(content, place):
    path = write(place / "goal.csv", content)
    found = sober(load_goal_path, str(path), where=place)
    if found:
        assert np.isfinite(found.offsets_m).all()


@cases(100)
@given(WORDS)
@example(LONG)
def test_goal_arm_and_motion_that_are_no_files(text):
    sober(load_goal_path, text)
    sober(load_recording, text)
    sober(load_mujoco, text)


GOOD_NPY = npy(np.column_stack([np.arange(1300) * 0.1, np.zeros((1300, 6))]))


@cases(300)
@given(
    content=st.one_of(
        st.tuples(st.just(".csv"), st.one_of(TABLES, number_tables(7, 1300).map(csv))),
        st.tuples(st.just(".npy"), st.one_of(st.binary(max_size=200), damaged(GOOD_NPY))),
        st.tuples(st.just(".npy"), number_tables(7, 1300).map(npy)),
        st.tuples(
            st.just(".npy"),
            st.sampled_from(["i1", "u8", "f2", "f4", ">f8", "S3", "O", "?", "c8", "M8[s]"]).map(
                lambda kind: npy(np.zeros((1300, 7)).astype(kind))
            ),
        ),
    ),
    scale=st.one_of(st.just(1.0), st.floats()),
)
@example(content=(".npy", npy(np.full((1300, 7), 1e308))), scale=1.0)
@example(content=(".npy", GOOD_NPY), scale=1.0)
@example(content=(".npy", GOOD_NPY), scale=5e-324)
@example(content=(".npy", GOOD_NPY), scale=1e308)
@example(
    content=(".npy", GOOD_NPY.replace(b"'shape': (1300, 7)", b"'shape': (1300, 7 ")), scale=1.0
)
@example(content=(".npy", GOOD_NPY.replace(b"(1300, 7)", b"(10**9,7)")), scale=1.0)
def test_motion_files(content, scale, place):
    ending, data = content
    path = write(place / f"motion{ending}", data)
    found = sober(lambda: load_recording(path, scale=scale), where=place)
    if found:
        assert np.isfinite(found.knots).all()
    path.unlink()


PAPER = (Path(__file__).resolve().parent.parent / "assets" / ARMS["paper"]).read_bytes()


@st.composite
def changed_arms(draw):
    """The paper's arm with elements removed, doubled or moved, and attributes changed."""
    root = ElementTree.fromstring(PAPER)
    for _ in range(draw(st.integers(1, 3))):
        parents = [e for e in root.iter() if len(e)]
        parent = draw(st.sampled_from(parents))
        child = draw(st.sampled_from(list(parent)))
        match draw(st.sampled_from(["remove", "double", "move", "number", "number", "attribute"])):
            case "remove":
                parent.remove(child)
            case "double":
                parent.append(child)
            case "move" if child not in parents:
                draw(st.sampled_from(parents)).append(child)
            case "number" if child.attrib:
                key = draw(st.sampled_from(sorted(child.attrib)))
                child.set(key, draw(st.one_of(NUMBERS, st.sampled_from(["0", "-1", "1 2", ""]))))
            case _:
                known = ["name", "type", "damping", "ref", "range", "gear", "axis", "quat", "what"]
                value = draw(st.sampled_from(["0", "1", "-1 1", "nan", "slide", "0 0 0", "x"]))
                child.set(draw(st.sampled_from(known)), value)
    return ElementTree.tostring(root)


def take_arm(path: Path):
    return load_arm(str(path), "tool")[1]


@cases(250)
@given(content=st.one_of(changed_arms(), changed_arms(), damaged(PAPER), st.binary(max_size=200)))
@example(content=b"")
@example(content=b"<mujoco/>")
@example(content=b"<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
def test_arm_files(content, place):
    path = write(place / "arm.xml", content)
    model = sober(take_arm, path, where=place)
    if model:
        assert model.nq >= 6 and hash(model) is not None
        numbers = jax.tree.leaves(dataclasses.astuple(model))
        assert not any(np.isnan(x) for x in numbers if isinstance(x, float))


# --- what a run directory holds ---

CONFIG = json.loads(command_line.config_to_json(preset_config("fast")))


@cases(300)
@given(
    content=st.one_of(
        changed_json(CONFIG).map(lambda values: json.dumps(values).encode()),
        damaged(json.dumps(CONFIG).encode()),
        JSON.map(lambda values: json.dumps(values).encode()),
        st.binary(max_size=50),
    )
)
@example(content=DEEP)
@example(content=b"\xff\xfe")
@example(content=json.dumps(CONFIG | {"num_envs": 10**400}).encode())
@example(content=json.dumps(CONFIG | {"ppo": CONFIG["ppo"] | {"gamma": 10**400}}).encode())
@example(content=json.dumps(CONFIG | {"seed": 2**40}).encode())
def test_config_files(content, place):
    run = place / "run"
    run.mkdir(exist_ok=True)
    write(run / "config.json", content)
    config = sober(stored_config, run, where=place)
    if config:
        again = command_line.config_from_json(TrainConfig, command_line.config_to_json(config))
        assert again == config
        assert 0 <= config.seed <= config.seed + config.seeds < 2**31 + 1


ROW = {"iteration": 1, "steps": 64, "seed": 0, "wall_s": 1.0, "pos_error_mm": 3.0}
ROWS = (json.dumps(ROW | {"ang_error_mrad": 2.0}) + "\n").encode() * 3


@cases(150)
@given(
    content=st.one_of(damaged(ROWS), st.binary(max_size=50), JSON.map(json.dumps).map(str.encode))
)
@example(content=b"1\n")
@example(content=b"{}\n")
@example(content=b"\xff\n")
@example(content=DEEP)
def test_metrics_files(content, place):
    """A row that is none is passed over: what a killed process or a full disk may leave."""
    run = place / "curves"
    run.mkdir(exist_ok=True)
    sober(learning_curves, write(run / METRICS, content).parent, where=place)
    sober(_cut_metrics, run / METRICS, 1)


META = PolicyMeta(obs_size=5, action_size=3, hidden=4)
POLICY = npz_bytes(Policy(init_params(META.net, jax.random.key(0), 5), init_stats((5,)), META))


def with_metadata(change: bytes) -> bytes:
    """The good policy file with other metadata."""
    arrays = dict(np.load(io.BytesIO(POLICY)))
    arrays["metadata"] = np.array(change.decode("utf-8", "replace"))
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


METADATA = json.loads(str(np.load(io.BytesIO(POLICY))["metadata"]))


def recompressed(method: int) -> bytes:
    """The same zip with another method's number in every header."""
    marked = POLICY.replace(b"\x00\x00\x00\x00!\x00", bytes([method, 0]) + b"\x00\x00!\x00")
    assert method == 0 or marked != POLICY
    return marked


@cases(250)
@given(
    content=st.one_of(
        damaged(POLICY),
        damaged(POLICY),
        st.binary(max_size=100),
        changed_json(METADATA).map(lambda values: with_metadata(json.dumps(values).encode())),
    )
)
@example(content=with_metadata(DEEP))
@example(content=recompressed(8))
@example(content=recompressed(99))
@example(content=with_metadata(json.dumps(METADATA | {"hidden": 0}).encode()))
@example(content=with_metadata(json.dumps(METADATA | {"hidden": "4"}).encode()))
@example(content=with_metadata(json.dumps(METADATA | {"config": 3}).encode()))
@example(content=with_metadata(json.dumps(METADATA | {"config": "3"}).encode()))
def test_policy_files(content, place):
    path = write(place / "policy.npz", content)
    policy = sober(load_policy, path, where=place)
    if policy:
        assert policy.meta.interface["rate_hz"] == 50
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(policy.params))
    path.unlink()


@pytest.fixture(scope="module")
def good_checkpoint(tmp_path_factory):
    run = tmp_path_factory.mktemp("checkpoint")
    checkpoint.save(run, 2, {"x": jax.numpy.ones(3), "y": jax.numpy.arange(4)}, "{}")
    return run


def test_checkpoints(good_checkpoint):
    folder = good_checkpoint / "checkpoints" / "2"
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    whole = json.loads((folder / checkpoint.MANIFEST).read_text())

    def signed(content) -> bytes:
        """A manifest with a right checksum of whatever it says."""
        digest = checkpoint._digest_of(content)
        return json.dumps(whole | {"content": content, "sha256": digest}).encode()

    damage = st.sampled_from(files).flatmap(
        lambda file: damaged(file.read_bytes()).map(lambda content: (file, content))
    )
    manifests = st.one_of(
        changed_json(whole).map(lambda values: json.dumps(values).encode()),
        changed_json(whole["content"]).map(signed),
    ).map(lambda content: (folder / checkpoint.MANIFEST, content))

    @cases(200)
    @given(st.one_of(damage, manifests))
    @example((folder / checkpoint.MANIFEST, DEEP))
    @example((folder / checkpoint.MANIFEST, signed({})))
    @example((folder / checkpoint.MANIFEST, signed([])))
    @example((folder / checkpoint.MANIFEST, signed(whole["content"] | {"files": {"..": "x"}})))
    @example((folder / checkpoint.MANIFEST, signed(whole["content"] | {"leaves": 3})))
    def check(case):
        file, content = case
        good = file.read_bytes()
        file.write_bytes(content)
        try:
            found = sober(checkpoint.check, good_checkpoint, 2, where=good_checkpoint)
            same = content == good or file.name == checkpoint.MANIFEST
            assert found is None or same, "damage that went unseen"
        finally:
            file.write_bytes(good)

    check()
    assert checkpoint.check(good_checkpoint, 2)["iteration"] == 2


def test_both_outcomes_were_met(request):
    """Last: a generator whose cases are all refused at the door would test little."""
    for test in sorted({test for test, _ in OUTCOMES}):
        taken, refused = OUTCOMES[test, True], OUTCOMES[test, False]
        print(f"{test}: {taken} taken, {refused} refused")
        assert refused >= 10 or "metrics" in test, test  # bad rows are passed over
        assert taken >= 1 or "no_files" in test, test
    print(f"{OUTCOMES.total()} cases")
    if len(request.session.items) > 15:  # not where one test was asked for
        assert OUTCOMES.total() >= 2000
