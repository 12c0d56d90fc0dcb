"""Every setting of training, each with one default and one sentence; validated on construction.

The command lines are generated from these dataclasses (`mcx_jax.config.command_line`), so a field's
docstring is its help text. Derived values are properties. All classes are hashable: they are
static under jit.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.errors import UserError, require

ADDED = {"added": True}
"""Metadata of a setting that files written before it lack; its default is what they did."""

MAX_SHARDS = 64
"""Most groups of environments (`TrainConfig.shards`), and so most devices that share one run."""
MAX_SEED = 2**31 - 1
"""Largest seed: 32 bits on the device."""


def check_seed(seed: int, seeds: int = 1) -> None:
    """Refuse a `--seed`, the first of `seeds`, that random numbers cannot be made from."""
    require(seed >= 0, f"--seed {seed}: must be 0 or a positive integer")
    require(
        seed + seeds - 1 <= MAX_SEED, f"--seed {seed}: the (last) seed must be at most {MAX_SEED}"
    )


@dataclass(frozen=True)
class PPOConfig:
    """PPO with a recurrent policy. Defaults = preset `fast`."""

    window_steps: int = 32
    """Control steps collected from every environment in one iteration."""
    sequence_steps: int = 32
    """Length of back-propagation through time; divides window_steps."""
    epochs: int = 2
    """Passes over the collected window in one iteration (--target-kl may end the policy's)."""
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
            require(0 < value < math.inf, f"--{name} {value}: must be positive")
        for name, value in {
            "entropy-coef": self.entropy_coef,
            "max-grad-norm": self.max_grad_norm,
        }.items():
            require(0 <= value < math.inf, f"--{name} {value}: must be 0 or positive")
        require(0 < self.gamma <= 1, f"--gamma {self.gamma}: must be above 0 and at most 1")
        require(0 <= self.gae_lambda <= 1, f"--gae-lambda {self.gae_lambda}: must be 0 to 1")
        require(
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
"""The paper's schedule to the letter. sigma = softplus(1)."""


@dataclass(frozen=True)
class FirstOrderConfig:
    """Back-propagation through the simulator (--algo first-order)."""

    horizon_steps: int = 10
    """Control steps that a gradient reaches through; the longest delay of the paper is two."""
    windows: int = 10
    """Windows of --horizon-steps, each with one gradient step, in one iteration."""
    relative_mm: float = 0.0
    """f of the loss f log(1 + e / f) for a window of an environment with mean error e, in mm and in
    mrad; 0 = off, the loss is e. For agents that train under easy and hard conditions at once: a
    tenth less counts about as much in each."""
    learning_rate: float = 1e-3
    """Adam step size, falling along half a cosine to 5 %. Not tuned since the gradient is that of
    unlimited servos; with the true one 3e-3 ended far worse than 1e-3."""

    def __post_init__(self) -> None:
        require(
            0 <= self.relative_mm < float("inf"),
            f"--relative-mm {self.relative_mm}: must be 0 or positive",
        )
        for name in ("horizon_steps", "windows", "learning_rate"):
            value = getattr(self, name)
            require(
                0 < value < float("inf"), f"--{name.replace('_', '-')} {value}: must be positive"
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
    start_from: str = field(default="", metadata=ADDED)
    """Begin with a trained policy's weights: of a run directory, a policy .npz, shipped:DELAY."""
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
            require(value > 0, f"--{name.replace('_', '-')} {value}: must be a positive integer")
        check_seed(self.seed, self.seeds)
        sequences = self.num_envs * (self.ppo.window_steps // self.ppo.sequence_steps)
        require(
            self.algo != "ppo" or sequences % self.ppo.minibatches == 0,
            f"--num-envs {self.num_envs} gives {sequences} sequences a window, which --minibatches "
            f"{self.ppo.minibatches} does not divide; use a multiple of {self.ppo.minibatches}",
        )
        name = "--window-steps" if self.algo == "ppo" else "--horizon-steps times --windows"
        require(
            self.env.episode_steps % self.iteration_steps == 0,
            f"--episode-steps {self.env.episode_steps} must be a multiple of {name} "
            f"{self.iteration_steps}",
        )
        require(
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
        require(preset == "fast", "--preset paper is PPO's schedule: leave it out of first-order")
        # 256 environments: the gradient has no exploration noise to average out.
        return TrainConfig(algo="first-order", num_envs=256, total_steps=5_000_000, env=paper_env)
    if preset == "fast":
        return TrainConfig()
    return TrainConfig(preset="paper", num_envs=8, env=paper_env, ppo=PAPER_PPO)
