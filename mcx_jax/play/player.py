"""The page's controls and its loop: simulate what is asked for, then play it in real time."""

import contextlib
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from mcx_jax import palette
from mcx_jax.controllers import CLASSICAL
from mcx_jax.delay import CONTROL_DT_S, NAMED_DELAYS
from mcx_jax.envs.v2v import V2VEnv, make_env
from mcx_jax.errors import UserError, reason
from mcx_jax.play.episode import EPISODES, Take, simulate
from mcx_jax.play.page import APART_M, Tableau, add_light, look_at
from mcx_jax.play.stage import Stage
from mcx_jax.play.waves import Surface, surface

STRIDE = 2
"""Control steps from one picture to the next: 25 a second."""
PLOT_EVERY = 5
"""Pictures from one update of the plot to the next."""


@dataclass(frozen=True)
class Choice:
    """What shall be seen."""

    who: str
    delay: str
    sea: str
    episode: int


class Player:
    """A page with its server. `serve` below runs it."""

    def __init__(self, config, entry):
        """
        Args:
            config: `PlayConfig`.
            entry: the controller asked for (`mcx_jax.report.entries.Entry`).
        """
        self._config = config
        self.controllers: dict[str, Any] = {**CLASSICAL, entry.label: entry.controller}
        self._trained_for = {entry.label: entry.settings.get("delay")}
        self.env: V2VEnv = make_env(config.env, config.motion, split="test")
        seas = self.env.motion.seas
        self.wanted = Choice(entry.label, config.env.delay, seas[-1], config.episode)
        self.playing = True
        try:
            with _quiet():
                self.server = viser.ViserServer(
                    host=config.host, port=config.port, label="mcx_jax", verbose=False
                )
        except OSError as error:
            raise UserError(
                f"--host {config.host} --port {config.port}: cannot be served ({reason(error)})"
            ) from None
        self.stage = Stage(config.env)
        add_light(self.server)
        look_at(self.server, 2)
        self.tableaux = [
            Tableau(self.server, self.stage, f"/scene_{i}", -i * APART_M) for i in range(2)
        ]
        self.take: Take | None = None
        self._surface: Surface | None = None
        self._plot: Any = None
        self._add_controls(list(dict.fromkeys([entry.label, *CLASSICAL])), seas)

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self._config.host
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        with _quiet():
            self.server.stop()

    def _add_controls(self, whos: list[str], seas: tuple[str, ...]) -> None:
        gui, wanted = self.server.gui, self.wanted
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._said = gui.add_markdown("")
        delays = tuple(dict.fromkeys([*NAMED_DELAYS, wanted.delay]))
        who = gui.add_dropdown("controller", whos, initial_value=wanted.who)
        delay = gui.add_dropdown("delay", delays, initial_value=wanted.delay)
        sea = gui.add_dropdown("sea", seas, initial_value=wanted.sea)
        pause = gui.add_button("Pause")
        another = gui.add_button("New episode")
        self._seek = gui.add_slider(
            "time, s", min=0.0, max=self._end_s, step=CONTROL_DT_S * STRIDE, initial_value=0.0
        )
        self._controls = [who, delay, sea, another]
        self._note = gui.add_markdown("", order=1000)
        self._sought_s: float | None = None

        @who.on_update
        def _(_) -> None:
            self.wanted = replace(self.wanted, who=who.value)

        @delay.on_update
        def _(_) -> None:
            self.wanted = replace(self.wanted, delay=delay.value)

        @sea.on_update
        def _(_) -> None:
            self.wanted = replace(self.wanted, sea=sea.value)

        @another.on_click
        def _(_) -> None:
            self.wanted = replace(self.wanted, episode=(self.wanted.episode + 1) % EPISODES)

        @pause.on_click
        def _(_) -> None:
            self.playing = not self.playing
            pause.label = "Pause" if self.playing else "Play"

        @self._seek.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # a hand, not the loop below
                self._sought_s = self._seek.value

    @property
    def _end_s(self) -> float:
        return CONTROL_DT_S * self._config.env.episode_steps

    def prepare(self, choice: Choice) -> None:
        """Simulate a choice and set the page up for it; minutes of nothing are announced."""
        self._said.content = (
            f"**Busy: simulating {choice.who}, delay {choice.delay}, sea {choice.sea}.** "
            "A new controller or delay is compiled first: 15 s to a minute."
        )
        for control in self._controls:
            control.disabled = True
        self.server.flush()
        env = self.env.with_delay(choice.delay)
        take = simulate(
            env,
            choice.who,
            self.controllers[choice.who],
            sea=env.motion.seas.index(choice.sea),
            seed=self._config.seed,
            episode=choice.episode,
        )
        self._surface = surface(take, self._config.motion, take.time_s[::STRIDE])
        self.take = take
        self.tableaux[1].root.visible = len(take.poses) > 1
        self._add_plot(take)
        self._note.content = (
            f"{self._surface.note} Its spectrum is the motion's; ripples finer than 0.6 m are left "
            "out. The hulls are drawn smaller than the 2.55 m ones whose motion this is: those "
            "would overlap at the task's distance. Thick axes: goal; thin and pale: tool."
            if not self._config.motion.motion
            else self._surface.note
        )
        self._said.content = self._headline(choice, take)
        for control in self._controls:
            control.disabled = False

    def _headline(self, choice: Choice, take: Take) -> str:
        means = ", ".join(
            f"{who} {1e3 * poses.pos_error_m.mean():.2f} mm"
            for who, poses in zip(take.names, take.poses, strict=True)
        )
        trained = self._trained_for.get(choice.who)
        strange = trained and not set(choice.delay.split(",")) <= set(trained.split(","))
        warning = f" **Trained for {trained}.**" if strange else ""
        return (
            f"Delay {take.delay}, sea {take.sea}, episode "
            f"{choice.episode}. Mean error: {means}.{warning}"
        )

    def _add_plot(self, take: Take) -> None:
        if self._plot is not None:
            self._plot.remove()
        series: list[Any] = [{"label": "s"}]
        for name, colour in palette.controllers(take.names).items():
            series.append({"label": f"{name}, mm", "stroke": colour, "width": 2})
        top_mm = 1.1 * max(np.nanquantile(1e3 * p.pos_error_m, 0.999) for p in take.poses)
        self._plot = self.server.gui.add_uplot(
            data=self._curves(take, STRIDE),
            series=tuple(series),
            title="position error, mm",
            scales={
                "x": {"time": False, "auto": False, "range": (0.0, self._end_s)},
                "y": {"auto": False, "range": (0.0, float(top_mm))},
            },
            legend={"show": True},
            aspect=1.6,
        )

    def _curves(self, take: Take, end: int) -> tuple[np.ndarray, ...]:
        """Time s and errors mm up to a control step."""
        errors = [1e3 * poses.pos_error_m[:end:STRIDE].astype(float) for poses in take.poses]
        return take.time_s[:end:STRIDE], *errors

    def show(self, frame: int) -> None:
        """One instant of the take."""
        assert self.take is not None and self._surface is not None
        step = frame * STRIDE
        with self.server.atomic():
            for name, poses, tableau in zip(
                self.take.names, self.take.poses, self.tableaux, strict=False
            ):
                self.stage.place(poses, step)
                tableau.place(self.stage)
                tableau.set_water(self._surface, frame)
                label = "IK baseline" if name == "ik" else name
                tableau.label.text = f"{label}: {1e3 * poses.pos_error_m[step]:.1f} mm"
            if frame % PLOT_EVERY == 0:
                self._plot.data = self._curves(self.take, step + STRIDE)
                self._seek.value = round(STRIDE * CONTROL_DT_S * frame, 3)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until `stop()` or an interrupt: follow the controls, play, begin again at the end."""
        shown: Choice | None = None
        now_s, last = 0.0, time.monotonic()
        while not stop():
            if self.wanted != shown:
                shown, now_s = self.wanted, 0.0
                self.prepare(shown)
                self._sought_s, last = None, time.monotonic()
            assert self.take is not None
            elapsed_s, last = time.monotonic() - last, time.monotonic()
            sought = self._sought_s
            if sought is not None:
                now_s, self._sought_s = sought, None
            elif self.playing:
                now_s = (now_s + elapsed_s) % self._end_s
            frames = -(-self.take.steps // STRIDE)
            if self.playing or sought is not None:
                self.show(min(int(now_s / (STRIDE * CONTROL_DT_S)), frames - 1))
            time.sleep(STRIDE * CONTROL_DT_S)


def serve(config, entry) -> None:
    """The page, until Ctrl-C."""
    player = Player(config, entry)
    try:
        print(f"open {player.url} (Ctrl-C ends)", flush=True)
        player.run()
    finally:
        player.stop()


def _quiet():
    """viser prints a box with addresses and its end, asked to be quiet or not."""
    return contextlib.redirect_stdout(io.StringIO())
