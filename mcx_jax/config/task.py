"""Settings of the simulated task: arm, delay, conditions, motion."""

from dataclasses import dataclass, field
from typing import Literal

from mcx_jax.config.delay import Delay, parse_delay
from mcx_jax.errors import UserError, require

COUPLED = "-coupled"
"""Ending of a sea's name: both vessels in one wave field."""


@dataclass(frozen=True)
class Range:
    """Bounds of a number that is drawn in each episode; equal: a constant."""

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
    """Disturbances: each a number, or LOW:HIGH to draw one per episode, uniformly
    (noise: uniformly in its root; the factor of the inertia: in its logarithm)."""

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
        require(self.ranges["wrist_inertia"].low > 0, "--wrist-inertia: must be above 0")

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
    integrator: Literal["model", "euler", "implicitfast", "quiet", "mixed"] = "model"
    """Integrator of the arm; model = as the arm's file says (paper: euler, ur10e: implicitfast);
    quiet = implicitfast as it was before MuJoCo 3.5, the one with the least chatter; mixed = euler
    or quiet, drawn per episode."""
    episode_steps: int = 1000
    """Control steps of 20 ms in an episode."""
    goal: str = "static"
    """Path of the goal on vessel B's deck: static, circle, lissajous, or a .csv file (t,x,y,z)."""
    max_correction: float = 5.0
    """Bound of each of the six components of a correction, cm and crad."""
    conditions: ConditionsConfig = field(default_factory=ConditionsConfig)

    def __post_init__(self) -> None:
        require(
            10 <= self.episode_steps <= 100_000,
            f"--episode-steps {self.episode_steps}: must be 10 to 100000 control steps of 20 ms",
        )
        require(
            0 < self.max_correction <= 100,
            f"--max-correction {self.max_correction}: must be above 0 and at most 100 (cm, crad)",
        )
        require(len(set(self.delays)) == len(self.delays), f"--delay {self.delay}: names one twice")
        beyond_mjx = self.conditions.changes_plant or self.integrator == "mixed"
        require(
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
class MotionConfig:
    """Where the vessels' motion comes from."""

    sea: str = "all"
    """Sea: all (Wa..Wd, one drawn per episode), one of Wa Wb Wc Wd, or Hs:Tp full scale (m:s).
    Several with commas between them: one drawn per episode. Ending in -coupled (Wa-coupled): both
    vessels in one wave field in that sea."""
    motion: str = ""
    """Recorded motion instead of the generator: .npy or .csv, columns t,x,y,z,roll,pitch,yaw (in
    any order where a .csv names them)."""
    motion_length_unit: Literal["m", "mm"] = "m"
    """Unit of x, y, z in --motion (the authors' files: mm)."""
    motion_angle_unit: Literal["rad", "deg"] = "rad"
    """Unit of roll, pitch, yaw in --motion (the authors' files: deg)."""
    motion_scale: float = 1.0
    """Froude scale of --motion: lengths are divided by it, time by its root (already scaled: 1)."""
    motion_axes: Literal["auto", "earth", "ship"] = field(default="auto", metadata={"added": True})
    """Axes of x, y in --motion: earth (fixed, those that yaw is counted from; turned into the axes
    of the mean heading), ship (the mean heading's already). auto = the same thing within 5 deg of
    mean yaw; beyond, you are asked."""
    coupled: bool = False
    """Both vessels in one wave field in every sea (the paper: independent windows). Not a floating
    arrangement: their midships are 1.5 m apart, one hull inside the other."""
    split: Literal["seeds", "paper"] = "seeds"
    """Test motion: another wave seed (seeds), or the last third of the same hour (paper)."""

    def is_coupled(self, sea: str) -> bool:
        """Whether both vessels are in one wave field in this one of the seas."""
        return self.coupled or sea.endswith(COUPLED)

    def __post_init__(self) -> None:
        require(self.motion_scale > 0, f"--motion-scale {self.motion_scale}: must be positive")
        require(
            not (self.motion and self.sea != "all"),
            f"--sea {self.sea} has no meaning with --motion: a recording is one sea; leave one out",
        )
        for name in ("motion_length_unit", "motion_angle_unit", "motion_scale", "motion_axes"):
            value, usual = getattr(self, name), getattr(MotionConfig, name)
            require(
                bool(self.motion) or value == usual,
                f"--{name.replace('_', '-')} {value} has no meaning without --motion; leave it out",
            )
        require(
            not (self.motion and self.coupled),
            "--coupled has no meaning with --motion: one recording holds one vessel; leave one out",
        )
