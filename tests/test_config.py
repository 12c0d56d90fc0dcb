"""Settings: delays with their true group delay, every refusal with its message, presets, no dead
knobs."""

import ast
import dataclasses
import inspect
import itertools
import math
import re
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from scipy.signal import butter, group_delay

import mcx_jax
from mcx_jax.config.delay import (
    CONTROL_DT_S,
    NAMED_DELAYS,
    NYQUIST_HZ,
    PHYSICS_DT_S,
    SUBSTEPS,
    Delay,
    parse_delay,
)
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.config.training import FirstOrderConfig, PPOConfig, TrainConfig, preset_config
from mcx_jax.errors import UserError

KNOWN = (
    "use one of E0, E1, E2, B4_21, B4_4, E<k> for k control steps, or butter:<order>:<cutoff>Hz, "
    "e.g. butter:4:7.5Hz"
)
NYQUIST = (
    "the cutoff must be at least 0.1 Hz and below the Nyquist frequency 25 Hz (control runs at "
    "50 Hz)"
)


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("E0", Delay("E0", steps=0)),
        ("E1", Delay("E1", steps=1)),
        ("E2", Delay("E2", steps=2)),
        ("E50", Delay("E50", steps=50)),
        ("explicit:3", Delay("explicit:3", steps=3)),
        ("B4_21", Delay("B4_21", order=4, cutoff_hz=20.8)),
        # The paper's erratum: its "B(4,4)" is 0.416 of Nyquist, not 4 Hz.
        ("B4_4", Delay("B4_4", order=4, cutoff_hz=10.4)),
        ("butter:4:7.5Hz", Delay("butter:4:7.5Hz", order=4, cutoff_hz=7.5)),
        ("butter:12:24.9", Delay("butter:12:24.9", order=12, cutoff_hz=24.9)),
        ("butter:1:0.2Hz", Delay("butter:1:0.2Hz", order=1, cutoff_hz=0.2)),
    ],
)
def test_delay_names_and_literals(text, want):
    assert parse_delay(text) == want
    assert EnvConfig(delay=text).delays == (want,)


def test_the_papers_cutoffs_as_shares_of_nyquist():
    assert NYQUIST_HZ == 25.0
    # Authors' code: 0.832 and 0.416 of Nyquist; 0.832 * 25 = 20.8, 0.416 * 25 = 10.4.
    assert parse_delay("B4_21").cutoff_hz / NYQUIST_HZ == pytest.approx(0.832)
    assert parse_delay("B4_4").cutoff_hz / NYQUIST_HZ == pytest.approx(0.416)


@pytest.mark.parametrize(
    ("name", "milliseconds"),
    [("E0", 0.0), ("E1", 20.0), ("E2", 40.0), ("B4_21", 7.1), ("B4_4", 34.1)],
)
def test_group_delay_of_the_named_delays(name, milliseconds):
    # The authors' figures, to their last digit.
    assert 1e3 * parse_delay(name).group_delay_s == pytest.approx(milliseconds, abs=0.05)


@pytest.mark.parametrize("order", range(1, 13))
@pytest.mark.parametrize("cutoff_hz", [2.0, 7.3, 10.4, 20.8, 24.5])
def test_group_delay_equals_scipy(order, cutoff_hz):
    sos = butter(order, cutoff_hz, fs=50.0, output="sos")
    # Section by section: the product's polynomials are ill-conditioned at low cutoffs.
    steps = sum(float(group_delay((s[:3], s[3:]), w=[0.0])[1][0]) for s in sos)
    delay = parse_delay(f"butter:{order}:{cutoff_hz}Hz")
    # 1e-9: at 2 Hz the poles' 1 + a1 + a2 = 0.06 loses 2 of 16 digits, and a section's two
    # terms nearly cancel.
    assert delay.group_delay_s == pytest.approx(0.02 * steps, rel=1e-9)


def test_group_delay_worked_by_hand():
    # Order 1: a single pole, tau = 1 / (2 / T tan(pi fc T)). fc = 12.5 Hz, T = 0.02: tan(pi / 4)
    # = 1, so tau = T / 2 = 10 ms.
    assert parse_delay("butter:1:12.5Hz").group_delay_s == pytest.approx(0.010, rel=1e-12)
    # Order 2: sin(pi / 4) + sin(3 pi / 4) = 1.41421 times that.
    assert parse_delay("butter:2:12.5Hz").group_delay_s == pytest.approx(0.0141421356, rel=1e-8)


def test_describe_prints_true_cutoff_and_delay():
    assert (
        parse_delay("B4_4").describe()
        == "B4_4: Butterworth order 4, cutoff 10.4 Hz, group delay 34.1 ms at 0 Hz"
    )
    assert parse_delay("E2").describe() == "E2: explicit delay of 2 control steps = 40 ms"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("B4", f"unknown delay 'B4': {KNOWN}"),
        ("", f"unknown delay '': {KNOWN}"),
        ("E-1", f"unknown delay 'E-1': {KNOWN}"),
        ("E1.5", f"unknown delay 'E1.5': {KNOWN}"),
        ("butter:-4:5Hz", f"unknown delay 'butter:-4:5Hz': {KNOWN}"),
        ("butter:4:-5Hz", f"unknown delay 'butter:4:-5Hz': {KNOWN}"),
        ("butter:4:nanHz", f"unknown delay 'butter:4:nanHz': {KNOWN}"),
        ("E51", "--delay E51: at most 50 control steps (1 s), e.g. E5"),
        ("butter:0:5Hz", "--delay butter:0:5Hz: the filter order must be 1 to 12"),
        ("butter:13:5Hz", "--delay butter:13:5Hz: the filter order must be 1 to 12"),
        ("butter:4:25Hz", f"--delay butter:4:25Hz: {NYQUIST}"),
        ("butter:4:40Hz", f"--delay butter:4:40Hz: {NYQUIST}"),
        ("butter:4:0.09Hz", f"--delay butter:4:0.09Hz: {NYQUIST}"),
        ("butter:4:0Hz", f"--delay butter:4:0Hz: {NYQUIST}"),
    ],
)
def test_delays_that_are_refused(text, message):
    with pytest.raises(UserError) as error:
        EnvConfig(delay=text)
    assert str(error.value) == message


def fast(**changes):
    return dataclasses.replace(preset_config("fast"), **changes)


REFUSED = {
    "episode too short": (
        lambda: EnvConfig(episode_steps=9),
        "--episode-steps 9: must be 10 to 100000 control steps of 20 ms",
    ),
    "episode too long": (
        lambda: EnvConfig(episode_steps=100_001),
        "--episode-steps 100001: must be 10 to 100000 control steps of 20 ms",
    ),
    "window": (lambda: PPOConfig(window_steps=0), "--window-steps 0: must be positive"),
    "sequence": (lambda: PPOConfig(sequence_steps=-1), "--sequence-steps -1: must be positive"),
    "epochs": (lambda: PPOConfig(epochs=0), "--epochs 0: must be positive"),
    "minibatches": (lambda: PPOConfig(minibatches=-2), "--minibatches -2: must be positive"),
    "hidden": (lambda: PPOConfig(hidden=0), "--hidden 0: must be positive"),
    "policy rate": (lambda: PPOConfig(policy_lr=0.0), "--policy-lr 0.0: must be positive"),
    "value rate": (lambda: PPOConfig(value_lr=math.nan), "--value-lr nan: must be positive"),
    "sigma": (lambda: PPOConfig(initial_sigma=-0.3), "--initial-sigma -0.3: must be positive"),
    "infinite": (lambda: PPOConfig(policy_lr=math.inf), "--policy-lr inf: must be positive"),
    "clip": (lambda: PPOConfig(clip=-0.15), "--clip -0.15: must be positive"),
    "kl": (lambda: PPOConfig(target_kl=0.0), "--target-kl 0.0: must be positive"),
    "rejection": (
        lambda: PPOConfig(reject_mean_sq_reward=0.0),
        "--reject-mean-sq-reward 0.0: must be positive",
    ),
    "entropy": (
        lambda: PPOConfig(entropy_coef=-0.01),
        "--entropy-coef -0.01: must be 0 or positive",
    ),
    "norm": (lambda: PPOConfig(max_grad_norm=-1.0), "--max-grad-norm -1.0: must be 0 or positive"),
    "gamma": (lambda: PPOConfig(gamma=1.01), "--gamma 1.01: must be above 0 and at most 1"),
    "gamma 0": (lambda: PPOConfig(gamma=0.0), "--gamma 0.0: must be above 0 and at most 1"),
    "lambda": (lambda: PPOConfig(gae_lambda=-0.1), "--gae-lambda -0.1: must be 0 to 1"),
    "sequence does not divide window": (
        lambda: PPOConfig(window_steps=32, sequence_steps=12),
        "--sequence-steps 12 must divide --window-steps 32",
    ),
    "sea and recording": (
        lambda: MotionConfig(motion="log.csv", sea="Wa"),
        "--sea Wa has no meaning with --motion: a recording is one sea; leave one out",
    ),
    "coupled recording": (
        lambda: MotionConfig(motion="log.csv", coupled=True),
        "--coupled has no meaning with --motion: one recording holds one vessel; leave one out",
    ),
    "slow filter": (
        lambda: EnvConfig(delay="butter:12:0.1Hz"),
        (
            "--delay butter:12:0.1Hz: delays by 12.2 s; at most 1 s: raise the cutoff or lower "
            "the order"
        ),
    ),
    "scale": (lambda: MotionConfig(motion_scale=0.0), "--motion-scale 0.0: must be positive"),
    "environments": (lambda: fast(num_envs=0), "--num-envs 0: must be a positive integer"),
    "steps": (lambda: fast(total_steps=-5), "--total-steps -5: must be a positive integer"),
    "seeds": (lambda: fast(seeds=0), "--seeds 0: must be a positive integer"),
    "seed": (lambda: fast(seed=-1), "--seed -1: must be 0 or a positive integer"),
    "sequences": (
        lambda: fast(num_envs=12, ppo=PPOConfig(minibatches=8)),
        (
            "--num-envs 12 gives 12 sequences a window, which --minibatches 8 does not divide; "
            "use a multiple of 8"
        ),
    ),
    "episode and window": (
        lambda: fast(env=EnvConfig(episode_steps=1000)),
        "--episode-steps 1000 must be a multiple of --window-steps 32",
    ),
    "paper's schedule is PPO's": (
        lambda: preset_config("paper", "first-order"),
        "--preset paper is PPO's schedule: leave it out of first-order",
    ),
    "preset": (lambda: preset_config("slow"), "unknown preset 'slow': use fast or paper"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_settings_that_are_refused(what):
    make, message = REFUSED[what]
    with pytest.raises(UserError) as error:
        make()
    assert str(error.value) == message


def test_limits_are_inclusive():
    assert EnvConfig(episode_steps=10).episode_steps == 10
    assert EnvConfig(episode_steps=100_000).episode_steps == 100_000
    assert PPOConfig(gamma=1.0, gae_lambda=0.0).gae_lambda == 0.0
    # Two sequences of 16 an environment: 4 * 2 = 8 minibatches of one sequence.
    ppo = PPOConfig(window_steps=32, sequence_steps=16, minibatches=8)
    assert fast(num_envs=4, ppo=ppo).num_envs == 4


def test_paper_preset_is_the_papers_schedule():
    paper = preset_config("paper")
    # Facts, "Networks and training": 8 trajectories of 1000 steps, 2500 epochs = 20 M steps.
    assert (paper.num_envs, paper.env.episode_steps, paper.total_steps) == (8, 1000, 20_000_000)
    assert (paper.iterations, paper.steps_per_iteration, paper.reset_groups) == (2500, 8000, 1)
    want = {
        "window_steps": 1000,
        "sequence_steps": 1000,
        "epochs": 80,
        "minibatches": 1,
        "gamma": 0.99,
        "gae_lambda": 0.97,
        "clip": 0.15,
        "entropy_coef": 0.01,
        "target_kl": 0.01,
        "policy_lr": 1e-4,
        "value_lr": 1e-4,
        "lr_decay": "constant",
        "max_grad_norm": 0.0,
        "value_target": "discounted",
        "hidden": 128,
        "cell": "lstm",
        "reject_mean_sq_reward": 0.008,
    }
    got = dataclasses.asdict(paper.ppo)
    assert {name: got[name] for name in want} == want
    assert set(got) - set(want) == {"initial_sigma"}
    # sigma = softplus(1) = log(1 + e) = 1.3133 cm.
    assert paper.ppo.initial_sigma == pytest.approx(math.log1p(math.e), rel=1e-15)


def test_fast_preset_and_derived_numbers():
    preset = preset_config("fast")
    assert (preset.preset, preset.num_envs, preset.env.episode_steps) == ("fast", 2048, 1024)
    # 1024 / 32 = 32 groups; 2048 * 32 = 65,536 steps; 20 M / 65,536 = 305.2, rounded up.
    assert (preset.reset_groups, preset.steps_per_iteration) == (32, 65_536)
    assert preset.iterations == 306
    assert fast(total_steps=65_536).iterations == 1
    assert fast(total_steps=65_537).iterations == 2


def test_defaults_are_the_papers_task():
    env = EnvConfig()
    assert (env.delay, env.arm, env.physics, env.integrator) == ("B4_4", "paper", "chain", "model")
    assert env.episode_steps == 1000
    assert (PHYSICS_DT_S, SUBSTEPS) == (0.002, 10)
    assert CONTROL_DT_S == pytest.approx(0.02, rel=1e-15)
    assert MotionConfig().sea == "all"


def test_configs_are_hashable_and_frozen():
    preset = preset_config("fast")
    assert hash(preset) == hash(preset_config("fast"))
    assert preset != fast(seed=1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset.seed = 3  # type: ignore[misc]


def _package_trees():
    root = Path(mcx_jax.__file__).parent
    for path in sorted(root.rglob("*.py")):
        yield path.relative_to(root).as_posix(), ast.parse(path.read_text())


def _fields_read() -> set[str]:
    """Names of all attributes that the package reads, validation (`__post_init__`) left out."""
    read = set()
    for _, tree in _package_trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name == "__post_init__":
                node.body = []
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                owner = ast.unparse(node.value)
                # `config.split` reads the setting, `text.split` does not.
                if re.search(r"(config|settings|self|env|motion|ppo|first_order|cfg|net)$", owner):
                    read.add(node.attr)
    return read


ALL_CONFIGS = [
    EnvConfig,
    ConditionsConfig,
    MotionConfig,
    PPOConfig,
    FirstOrderConfig,
    TrainConfig,
]


@pytest.mark.parametrize("cls", ALL_CONFIGS)
def test_every_setting_is_read_somewhere(cls):
    names = set(get_type_hints(cls))
    assert names - _fields_read() == set()


@pytest.mark.parametrize("cls", ALL_CONFIGS)
def test_every_setting_has_a_sentence(cls):
    """The command line's help is the string below each field."""
    tree = ast.parse(Path(inspect.getfile(cls)).read_text())
    body = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == cls.__name__).body
    described = {
        node.target.id
        for node, after in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
    }
    nested = {TrainConfig: {"env", "motion", "ppo", "first_order"}, EnvConfig: {"conditions"}}
    assert {f.name for f in dataclasses.fields(cls)} - described == nested.get(cls, set())


def test_named_delays_are_the_papers_five():
    assert list(NAMED_DELAYS) == ["E0", "E1", "E2", "B4_21", "B4_4"]
    delays = [parse_delay(name).group_delay_s for name in NAMED_DELAYS]
    assert np.argsort(delays).tolist() == [0, 3, 1, 4, 2]  # E0, B4_21, E1, B4_4, E2
