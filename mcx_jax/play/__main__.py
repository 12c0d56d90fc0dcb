"""`python -m mcx_jax.play WHO`: look at a controller, in the browser, as a film or as a picture.

WHO is whatever `evaluate` takes; ik is always beside it.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.config.training import check_seed
from mcx_jax.console.command import interruptible
from mcx_jax.errors import UserError


@dataclass(frozen=True)
class PlayConfig:
    """A test episode in the browser; with --video or --frame as a file. Beside the IK baseline."""

    who: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WHO")]
    """ik, extrapolate, extrapolate-best, fir, preview, shipped:DELAY, a run directory, or a policy
    .npz file."""
    video: str = ""
    """Write a film to this .mp4 file instead of serving a page."""
    frame: str = ""
    """Write one picture to this .png file instead of serving a page."""
    at: float = 10.0
    """When in the episode, seconds, for --frame."""
    seed: int = 0
    """Seed of the episodes' windows and goals, as in evaluate."""
    episode: int = 0
    """Which of evaluate's 50 episodes (0 to 49)."""
    host: str = "127.0.0.1"
    """Address that the page is served at; 0.0.0.0 lets other machines see it."""
    port: int = 8080
    """Port that the page is served at; the next free one if it is taken."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to simulate; auto = GPU if JAX has one."""
    env: EnvConfig = field(default_factory=EnvConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not 0 <= self.episode < 50:
            raise UserError(f"--episode {self.episode}: must be 0 to 49")
        if not 1 <= self.port <= 65535:
            raise UserError(f"--port {self.port}: must be 1 to 65535")
        end_s = self.env.episode_steps * CONTROL_DT_S
        if self.frame and not 0 <= self.at <= end_s:
            raise UserError(f"--at {self.at:g}: the episode is {end_s:g} s long; 0 to {end_s:g}")
        if self.video and self.frame:
            raise UserError("--video and --frame: one at a time")
        for flag, path, ending in (
            ("--video", self.video, ".mp4"),
            ("--frame", self.frame, ".png"),
        ):
            if path and Path(path).suffix != ending:
                raise UserError(f"{flag} {path}: the file's name must end in {ending}")

    @property
    def to_file(self) -> bool:
        """Whether a file is asked for, not the page."""
        return bool(self.video or self.frame)


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import extras
    from mcx_jax.compute import startup
    from mcx_jax.config import command_line
    from mcx_jax.controllers.by_name import fit_if_needed
    from mcx_jax.report import entries

    argv = list(sys.argv[1:] if argv is None else argv)
    config = command_line.parse(PlayConfig, argv, prog="play")
    (name,) = entries.check_names([config.who])[-1:]
    command_line.check_output("--video", config.video)
    command_line.check_output("--frame", config.frame)
    extras.require("imageio_ffmpeg" if config.video else "PIL" if config.frame else "viser", "play")
    if config.to_file:
        from mcx_jax.play import gl

        gl.choose()
    for line in startup.configure(config.device, mjx=config.env.physics == "mjx"):
        print(line)
    (entry,) = entries.load_entries([name])
    own = dataclasses.replace(EnvConfig(), **entries.common_settings([entry], argv))
    # Again, with the policy's own task as the defaults.
    who = PlayConfig(who=config.who, env=own)
    config = command_line.parse(PlayConfig, argv, prog="play", default=who)
    print(config.env.describe_delays(), flush=True)
    if entry.controller is None:
        fitted = fit_if_needed(entry.who, None, config.env, config.motion, "")
        entry = dataclasses.replace(entry, controller=fitted)
    try:
        with interruptible():
            if config.to_file:
                to_file(config, entry)
            else:
                from mcx_jax.play.player import serve

                serve(config, entry)
    except KeyboardInterrupt:
        print("\nstopped")
        # A page is there until it is stopped; a file is not written.
        raise SystemExit(130 if config.to_file else 0) from None


def to_file(config: PlayConfig, entry) -> None:
    """Simulate the episode in the last sea and write the film or the picture."""
    from mcx_jax.envs.v2v import make_env
    from mcx_jax.play import video
    from mcx_jax.play.episode import simulate

    print("simulating (the first time the program is compiled, about half a minute)", flush=True)
    env = make_env(config.env, config.motion, split="test")
    sea = len(env.motion.seas) - 1
    take = simulate(
        env, entry.label, entry.controller, sea=sea, seed=config.seed, episode=config.episode
    )
    for who, poses in zip(take.names, take.poses, strict=True):
        mm, mrad = 1e3 * poses.pos_error_m.mean(), 1e3 * poses.ang_error_rad.mean()
        print(f"{who}: sea {take.sea}, mean {mm:.2f} mm, {mrad:.2f} mrad", flush=True)
    if config.frame:
        video.write_frame(Path(config.frame), take, config.env, config.motion, config.at)
        print(f"done: {config.frame}")
        return
    say = lambda text: print(text, flush=True)  # noqa: E731
    frames = video.write_film(Path(config.video), take, config.env, config.motion, say)
    print(f"done: {config.video}, {frames} frames, {video.FPS} a second")


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
