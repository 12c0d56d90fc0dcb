"""Every setting of the program, each with one default and one sentence; validated on construction.

The command lines are generated from these dataclasses (`mcx_jax.cli`), so a field's docstring is
its help text. Derived values are properties. All classes are hashable: they are static under jit.
"""

import math
import re
from dataclasses import dataclass, field
from typing import Literal

from mcx_jax.errors import UserError

PHYSICS_DT_S = 0.002
"""Physics step: 500 Hz (paper; authors' code)."""
SUBSTEPS = 10
"""Physics steps per control step."""
CONTROL_DT_S = PHYSICS_DT_S * SUBSTEPS
"""Control step: 50 Hz (paper; authors' code)."""
NYQUIST_HZ = 0.5 / CONTROL_DT_S

MAX_SHARDS = 64
"""Most groups of environments (`TrainConfig.shards`), and so most devices that share one run."""
MAX_DELAY_S = 1.0
"""Longest delay accepted: evaluation looks that far ahead, and slower filters drift in float32."""

MAX_SEED = 2**31 - 1
"""Largest seed: 32 bits on the device."""

NAMED_DELAYS = {
    "E0": "explicit:0",
    "E1": "explicit:1",
    "E2": "explicit:2",
    "B4_21": "butter:4:20.8Hz",
    "B4_4": "butter:4:10.4Hz",
}
"""The five delays of the paper's table 2. "B(4,4)" is an erratum of the paper: 4 Hz would delay by
102 ms; the authors' code has 0.416 of Nyquist = 10.4 Hz, 34 ms, and only that fits table 3."""


@dataclass(frozen=True)
class Delay:
    """How late the arm answers: a queue of control steps, or a low-pass filter, on the joint
    references (paper section 3, table 2)."""

    name: str
    steps: int = 0
    """Explicit delay k in control steps of 20 ms."""
    order: int = 0
    """Order of the Butterworth filter; 0 = no filter."""
    cutoff_hz: float = 0.0
    """-3 dB frequency of the Butterworth filter."""

    @property
    def group_delay_s(self) -> float:
        """Delay of a slow motion, seconds: k * 20 ms, or the filter's group delay at 0 Hz."""
        return self.steps * CONTROL_DT_S + _butter_dc_group_delay_s(self.order, self.cutoff_hz)

    def describe(self) -> str:
        """One line with the true cutoff and delay, printed whenever a delay is named."""
        if self.order:
            return (
                f"{self.name}: Butterworth order {self.order}, cutoff {self.cutoff_hz:g} Hz, "
                f"group delay {1e3 * self.group_delay_s:.1f} ms at 0 Hz"
            )
        milliseconds = 1e3 * self.group_delay_s
        return f"{self.name}: explicit delay of {self.steps} control steps = {milliseconds:.0f} ms"


def _butter_dc_group_delay_s(order: int, cutoff_hz: float) -> float:
    """Group delay at 0 Hz of the bilinear-transformed Butterworth low-pass.

    An analogue pole pair contributes sin(theta)/w_c each, summing to 1/(w_c) * sum over poles of
    Re(-1/p); the bilinear map with prewarping has w_c = (2/T) tan(pi f_c T) and dw/dW = 1 at 0.
    """
    if order == 0:
        return 0.0
    wc = 2.0 / CONTROL_DT_S * math.tan(math.pi * cutoff_hz * CONTROL_DT_S)
    angles = [math.pi * (2 * k + 1) / (2 * order) for k in range(order)]
    return sum(math.sin(angle) for angle in angles) / wc


def parse_delay(text: str) -> Delay:
    """Read `E3`, `B4_4`, `B4_21` or a literal `butter:ORDER:CUTOFFHz`.

    Raises:
        UserError: unknown form, cutoff at or above Nyquist (25 Hz), order or steps out of range.
    """
    literal = NAMED_DELAYS.get(text, text)
    if match := re.fullmatch(r"(?:explicit:|E)([0-9]{1,9})", literal):
        steps = int(match[1])
        if steps > 50:
            raise UserError(f"--delay {text}: at most 50 control steps (1 s), e.g. E5")
        return Delay(name=text, steps=steps)
    if match := re.fullmatch(r"butter:([0-9]{1,9}):([0-9]+(?:\.[0-9]+)?)(?:Hz)?", literal):
        order, cutoff_hz = int(match[1]), float(match[2])
        if not 1 <= order <= 12:
            raise UserError(f"--delay {text}: the filter order must be 1 to 12")
        if not 0.1 <= cutoff_hz < NYQUIST_HZ:
            raise UserError(
                f"--delay {text}: the cutoff must be at least 0.1 Hz and below the Nyquist "
                f"frequency {NYQUIST_HZ:g} Hz (control runs at 50 Hz)"
            )
        delay = Delay(name=text, order=order, cutoff_hz=cutoff_hz)
        if delay.group_delay_s > MAX_DELAY_S:
            raise UserError(
                f"--delay {text}: delays by {delay.group_delay_s:.1f} s; at most {MAX_DELAY_S:g} "
                "s: raise the cutoff or lower the order"
            )
        return delay
    raise UserError(
        f"unknown delay '{text}': use one of {', '.join(NAMED_DELAYS)}, E<k> for k control steps, "
        "or butter:<order>:<cutoff>Hz, e.g. butter:4:7.5Hz"
    )


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise UserError(message)


def check_seed(seed: int, seeds: int = 1) -> None:
    """Refuse a `--seed`, the first of `seeds`, that random numbers cannot be made from."""
    _require(seed >= 0, f"--seed {seed}: must be 0 or a positive integer")
    _require(
        seed + seeds - 1 <= MAX_SEED, f"--seed {seed}: the (last) seed must be at most {MAX_SEED}"
    )


@dataclass(frozen=True)
class Range:
    """Bounds of a number that is drawn uniformly in each episode; equal: a constant."""

    low: float
    high: float


def parse_range(flag: str, text: str, limit: float, whole: bool = False) -> Range:
    """Read `X` or `LOW:HIGH`, both from 0 to `limit`.

    Args:
        flag: for the message, e.g. `--noise-mm`.
        whole: whole numbers only.
    """
    try:
        bounds = [float(word) for word in text.split(":")]
    except ValueError:
        bounds = []
    ok = len(bounds) in (1, 2) and 0 <= bounds[0] <= bounds[-1] <= limit
    if not ok or (whole and any(x != int(x) for x in bounds)):
        kind = "whole number" if whole else "number"
        raise UserError(
            f"{flag} {text}: use a {kind} from 0 to {limit:g}, or LOW:HIGH for a new one in each "
            "episode"
        )
    return Range(bounds[0], bounds[-1])


@dataclass(frozen=True)
class ConditionsConfig:
    """What is not as it should be: a number, or LOW:HIGH for one drawn in each episode."""

    noise_mm: str = "0"
    """White noise of the goal's measured position, standard deviation of each axis, mm."""
    noise_mrad: str = "0"
    """White noise of the goal's measured orientation, standard deviation about each axis, mrad."""
    latency_steps: str = "0"
    """Age of the goal's measured pose, control steps of 20 ms; known, by its time stamp."""
    payload_kg: str = "0"
    """Point mass at the tool, kg."""
    wrist_inertia: str = "1"
    """Factor of the rotational inertia of the arm's last link."""

    def __post_init__(self) -> None:
        _require(self.ranges["wrist_inertia"].low > 0, "--wrist-inertia: must be above 0")

    @property
    def ranges(self) -> dict[str, Range]:
        """Every setting as numbers, by its name."""
        return {
            "noise_mm": parse_range("--noise-mm", self.noise_mm, 1e3),
            "noise_mrad": parse_range("--noise-mrad", self.noise_mrad, 1e3),
            "latency_steps": parse_range("--latency-steps", self.latency_steps, 50, whole=True),
            "payload_kg": parse_range("--payload-kg", self.payload_kg, 1e3),
            "wrist_inertia": parse_range("--wrist-inertia", self.wrist_inertia, 1e3),
        }

    @property
    def changes_plant(self) -> bool:
        """Whether the arm is not the one of its file."""
        found = self.ranges
        return found["payload_kg"] != Range(0, 0) or found["wrist_inertia"] != Range(1, 1)

    @property
    def imperfect_sensor(self) -> bool:
        """Whether the goal's measured pose is not the true one."""
        return self.noisy or self.late_sensor

    @property
    def late_sensor(self) -> bool:
        """Whether measurements come late; the observation then ends with their age."""
        return self.ranges["latency_steps"].high > 0

    @property
    def noisy(self) -> bool:
        """Whether measurements have noise."""
        return max(self.ranges["noise_mm"].high, self.ranges["noise_mrad"].high) > 0


@dataclass(frozen=True)
class EnvConfig:
    """The simulated task. Frames: I inertial, B arm base (on vessel A), E tool, G goal (on B)."""

    delay: str = "B4_4"
    """Actuation delay: E0, E1, E2, B4_21, B4_4 (the paper's names), E<k>, butter:<order>:<Hz>Hz.
    Several with commas between them: one drawn per episode."""
    arm: str = "paper"
    """Arm model: paper (table 3's UR10e), ur10e (manufacturer's inertia), or an MJCF file."""
    tool_site: str = "tool"
    """Name of the site in the arm model that is the tool centre point E."""
    physics: Literal["chain", "mjx"] = "chain"
    """Engine: chain (this project's, fast) or mjx (MuJoCo's own, the reference)."""
    integrator: Literal["model", "euler", "implicitfast", "mixed"] = "model"
    """Integrator of the arm; model = as the arm's file says (paper: euler, ur10e: implicitfast);
    mixed = euler or implicitfast, drawn per episode."""
    episode_steps: int = 1000
    """Control steps of 20 ms in an episode."""
    goal: str = "static"
    """Path of the goal on vessel B's deck: static, circle, lissajous, or a .csv file (t,x,y,z)."""
    max_correction: float = 5.0
    """Bound of each of the six components of a correction, cm and crad."""
    conditions: ConditionsConfig = field(default_factory=ConditionsConfig)

    def __post_init__(self) -> None:
        _require(
            10 <= self.episode_steps <= 100_000,
            f"--episode-steps {self.episode_steps}: must be 10 to 100000 control steps of 20 ms",
        )
        _require(
            0 < self.max_correction <= 100,
            f"--max-correction {self.max_correction}: must be above 0 and at most 100 (cm, crad)",
        )
        _require(
            len(set(self.delays)) == len(self.delays), f"--delay {self.delay}: names one twice"
        )
        beyond_mjx = self.conditions.changes_plant or self.integrator == "mixed"
        _require(
            self.physics == "chain" or not beyond_mjx,
            "--physics mjx simulates the arm's file as it is: no --payload-kg, --wrist-inertia or "
            "--integrator mixed",
        )

    @property
    def delays(self) -> tuple[Delay, ...]:
        """The delays as numbers."""
        return tuple(parse_delay(name) for name in self.delay.split(","))

    def describe_delays(self) -> str:
        """One line a delay, see `Delay.describe`."""
        return "\n".join(delay.describe() for delay in self.delays)


@dataclass(frozen=True)
class PPOConfig:
    """PPO with a recurrent policy. Defaults = preset `fast`."""

    window_steps: int = 32
    """Control steps collected from every environment in one iteration."""
    sequence_steps: int = 32
    """Length of back-propagation through time; divides window_steps."""
    epochs: int = 2
    """Passes over the collected window in one iteration (policy and value at most that many)."""
    minibatches: int = 16
    """Minibatches of whole sequences per pass."""
    gamma: float = 0.9
    """Discount per control step."""
    gae_lambda: float = 0.9
    """Lambda of generalised advantage estimation."""
    clip: float = 0.15
    """Clipping of the probability ratio."""
    entropy_coef: float = 0.0
    """Weight of the policy's entropy."""
    target_kl: float = 0.05
    """Policy updates of an iteration stop when the KL estimate exceeds 1.5 times this."""
    policy_lr: float = 2e-3
    """Adam step size of the policy."""
    value_lr: float = 2e-3
    """Adam step size of the value network."""
    lr_decay: Literal["constant", "cosine"] = "cosine"
    """Schedule of both step sizes over --total-steps (cosine ends at 5 %)."""
    max_grad_norm: float = 1.0
    """Global-norm clipping of each network's gradient; 0 = none."""
    value_target: Literal["lambda", "discounted"] = "lambda"
    """Value target: GAE return (lambda) or the paper's discounted return."""
    initial_sigma: float = 0.3
    """Initial standard deviation of the actions, centimetres and centiradians (paper: 1.31)."""
    hidden: int = 128
    """Width of the two dense layers and of the recurrent cell."""
    cell: Literal["lstm", "gru"] = "lstm"
    """Recurrent cell of both networks (paper: lstm)."""
    reject_mean_sq_reward: float = 0.008
    """A window (paper: episode) with a larger mean squared reward is masked out (authors' code)."""

    def __post_init__(self) -> None:
        positive = {
            "window-steps": self.window_steps,
            "sequence-steps": self.sequence_steps,
            "epochs": self.epochs,
            "minibatches": self.minibatches,
            "hidden": self.hidden,
            "policy-lr": self.policy_lr,
            "value-lr": self.value_lr,
            "initial-sigma": self.initial_sigma,
            "clip": self.clip,
            "target-kl": self.target_kl,
            "reject-mean-sq-reward": self.reject_mean_sq_reward,
        }
        for name, value in positive.items():
            _require(0 < value < math.inf, f"--{name} {value}: must be positive")
        for name, value in {
            "entropy-coef": self.entropy_coef,
            "max-grad-norm": self.max_grad_norm,
        }.items():
            _require(0 <= value < math.inf, f"--{name} {value}: must be 0 or positive")
        _require(0 < self.gamma <= 1, f"--gamma {self.gamma}: must be above 0 and at most 1")
        _require(0 <= self.gae_lambda <= 1, f"--gae-lambda {self.gae_lambda}: must be 0 to 1")
        _require(
            self.window_steps % self.sequence_steps == 0,
            f"--sequence-steps {self.sequence_steps} must divide --window-steps "
            f"{self.window_steps}",
        )


PAPER_PPO = PPOConfig(
    window_steps=1000,
    sequence_steps=1000,
    epochs=80,
    minibatches=1,
    gamma=0.99,
    gae_lambda=0.97,
    clip=0.15,
    entropy_coef=0.01,
    target_kl=0.01,
    policy_lr=1e-4,
    value_lr=1e-4,
    lr_decay="constant",
    max_grad_norm=0.0,
    value_target="discounted",
    initial_sigma=1.3132616875182228,
)
"""The paper's schedule to the letter (facts: networks and training). sigma = softplus(1)."""


@dataclass(frozen=True)
class FirstOrderConfig:
    """Back-propagation through the simulator (--algo first-order)."""

    horizon_steps: int = 10
    """Control steps that a gradient reaches through; the longest delay of the paper is two."""
    windows: int = 10
    """Windows of --horizon-steps, each with one gradient step, in one iteration."""
    tail_mm: float = 1.0
    """Errors beyond this (mm + mrad) weigh more: the loss is e + e^2 / (2 tail_mm)."""
    learning_rate: float = 1e-3
    """Adam step size, falling along half a cosine to 5 %. Not tuned since the gradient is that of
    unlimited servos; with the true one 3e-3 ended far worse than 1e-3."""

    def __post_init__(self) -> None:
        for name in ("horizon_steps", "windows", "tail_mm", "learning_rate"):
            value = getattr(self, name)
            _require(
                0 < value < float("inf"), f"--{name.replace('_', '-')} {value}: must be positive"
            )


@dataclass(frozen=True)
class MotionConfig:
    """Where the vessels' motion comes from."""

    sea: str = "all"
    """Sea: all (Wa..Wd, one drawn per episode), one of Wa Wb Wc Wd, or Hs:Tp full scale (m:s).
    Several with commas between them: one drawn per episode."""
    motion: str = ""
    """Recorded motion instead of the generator: .npy or .csv, columns t,x,y,z,roll,pitch,yaw."""
    motion_length_unit: Literal["m", "mm"] = "m"
    """Unit of x, y, z in --motion (the authors' files: mm)."""
    motion_angle_unit: Literal["rad", "deg"] = "rad"
    """Unit of roll, pitch, yaw in --motion (the authors' files: deg)."""
    motion_scale: float = 1.0
    """Froude scale of --motion: lengths are divided by it, time by its root (already scaled: 1)."""
    coupled: bool = False
    """Both vessels in one wave field instead of independent windows (the paper: independent)."""
    split: Literal["seeds", "paper"] = "seeds"
    """Test motion: another wave seed (seeds), or the last third of the same hour (paper)."""

    def __post_init__(self) -> None:
        _require(self.motion_scale > 0, f"--motion-scale {self.motion_scale}: must be positive")
        _require(
            not (self.motion and self.sea != "all"),
            f"--sea {self.sea} has no meaning with --motion: a recording is one sea; leave one out",
        )
        _require(
            not (self.motion and self.coupled),
            "--coupled has no meaning with --motion: one recording holds one vessel; leave one out",
        )


@dataclass(frozen=True)
class TrainConfig:
    """Everything that defines a training run (stored as config.json in the run directory)."""

    preset: Literal["fast", "paper"] = "fast"
    """Defaults of all other settings: fast, or the paper's schedule to the letter."""
    algo: Literal["ppo", "first-order"] = "ppo"
    """Learning algorithm: ppo, or first-order (gradient through the simulator)."""
    num_envs: int = 2048
    """Environments stepped in parallel."""
    total_steps: int = 20_000_000
    """Control steps of training, summed over the environments (paper: 20 M)."""
    seed: int = 0
    """Random seed."""
    seeds: int = 1
    """Train this many seeds (seed, seed+1, ...) in one vmapped call."""
    env: EnvConfig = field(default_factory=lambda: EnvConfig(episode_steps=1024))
    motion: MotionConfig = field(default_factory=MotionConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    first_order: FirstOrderConfig = field(default_factory=FirstOrderConfig)

    def __post_init__(self) -> None:
        for name in ("num_envs", "total_steps", "seeds"):
            value = getattr(self, name)
            _require(value > 0, f"--{name.replace('_', '-')} {value}: must be a positive integer")
        check_seed(self.seed, self.seeds)
        sequences = self.num_envs * (self.ppo.window_steps // self.ppo.sequence_steps)
        _require(
            sequences % self.ppo.minibatches == 0,
            f"--num-envs {self.num_envs} gives {sequences} sequences a window, which --minibatches "
            f"{self.ppo.minibatches} does not divide; use a multiple of {self.ppo.minibatches}",
        )
        name = "--window-steps" if self.algo == "ppo" else "--horizon-steps times --windows"
        _require(
            self.env.episode_steps % self.iteration_steps == 0,
            f"--episode-steps {self.env.episode_steps} must be a multiple of {name} "
            f"{self.iteration_steps}",
        )
        _require(
            self.algo == "ppo" or self.env.physics == "chain",
            f"--algo {self.algo} needs --physics chain: MJX's step has no useful derivative here",
        )

    @property
    def iteration_steps(self) -> int:
        """Control steps that every environment makes in an iteration."""
        if self.algo == "first-order":
            return self.first_order.horizon_steps * self.first_order.windows
        return self.ppo.window_steps

    @property
    def reset_groups(self) -> int:
        """Environments are reset in this many groups, one an iteration (see ppo.rollout)."""
        return self.env.episode_steps // self.iteration_steps

    @property
    def shards(self) -> int:
        """S, the number of equal groups of environments that resets and minibatches treat alike
        (see sharding). As many as possible, up to 64: more devices than that are not used."""
        ppo = self.ppo
        sequences = ppo.window_steps // ppo.sequence_steps if self.algo == "ppo" else 1
        minibatches = ppo.minibatches if self.algo == "ppo" else 1

        def fits(shards: int) -> bool:
            envs, rest = divmod(self.num_envs, shards)
            return not rest and envs >= self.reset_groups and envs * sequences % minibatches == 0

        return max([s for s in range(1, MAX_SHARDS + 1) if fits(s)], default=1)

    @property
    def block_envs(self) -> int:
        """Environments that are reset before an iteration: in every shard its share, rounded up."""
        return self.shards * -(-self.num_envs // self.shards // self.reset_groups)

    @property
    def steps_per_iteration(self) -> int:
        """Control steps collected per iteration and seed."""
        return self.num_envs * self.iteration_steps

    @property
    def iterations(self) -> int:
        """Iterations needed for total_steps, rounded up."""
        return -(-self.total_steps // self.steps_per_iteration)


def preset_config(preset: str, algo: str = "ppo") -> TrainConfig:
    """The defaults of a preset (`fast` or `paper`) and an algorithm."""
    if preset not in ("fast", "paper"):
        raise UserError(f"unknown preset '{preset}': use fast or paper")
    paper_env = EnvConfig(episode_steps=1000)
    if algo == "first-order":
        _require(preset == "fast", "--preset paper is PPO's schedule: leave it out of first-order")
        # 256 environments: the gradient has no exploration noise to average out.
        return TrainConfig(algo="first-order", num_envs=256, total_steps=5_000_000, env=paper_env)
    if preset == "fast":
        return TrainConfig()
    return TrainConfig(preset="paper", num_envs=8, env=paper_env, ppo=PAPER_PPO)
