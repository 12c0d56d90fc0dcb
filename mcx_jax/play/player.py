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
from mcx_jax.assets import SHIPPED, asset_path
from mcx_jax.config.delay import CONTROL_DT_S, NAMED_DELAYS
from mcx_jax.controllers.by_name import FITTED, WHO, fit_if_needed
from mcx_jax.envs.v2v import V2VEnv, make_env
from mcx_jax.errors import UserError, reason
from mcx_jax.play.episode import EPISODES, Take, describe_sea, simulate
from mcx_jax.play.page import Tableau, View, add_light, aim, look_at, overview
from mcx_jax.play.picture import MUTED
from mcx_jax.play.renderer import Stage
from mcx_jax.play.waves import Surface, surface
from mcx_jax.report.entries import load_entries

STRIDE = 2
"""Control steps from one picture to the next: 25 a second."""
PLOT_EVERY = 5
"""Pictures from one update of plots and numbers to the next."""
PHONE_PX = 700
"""A window narrower than this has the panel at its bottom."""
VIEWS = ("overview", "close-up of IK baseline", "close-up of controller")


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
        self._menu = Menu(config, entry)
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
        self.tableaux = [Tableau(self.server, self.stage, f"/scene_{i}", i) for i in range(2)]
        self.take: Take | None = None
        self._surface: Surface | None = None
        self._plots: list[ErrorPlot] = []
        self._goals: list[View] = []
        self._add_controls(seas)
        self.server.on_client_connect(_leave_room)

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self._config.host
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        with _quiet():
            self.server.stop()

    def _add_controls(self, seas: tuple[str, ...]) -> None:
        gui, wanted = self.server.gui, self.wanted
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._said = gui.add_markdown("")
        delays = tuple(dict.fromkeys([*NAMED_DELAYS, wanted.delay]))
        self._choices = {
            "who": gui.add_dropdown("controller", self._menu.names, initial_value=wanted.who),
            "delay": gui.add_dropdown("delay", delays, initial_value=wanted.delay),
            "sea": gui.add_dropdown("sea", seas, initial_value=wanted.sea),
        }
        for name, choice in self._choices.items():
            choice.on_update(lambda _, name=name, choice=choice: self._want(name, choice.value))
        self._view = gui.add_dropdown("view", VIEWS, hint="From below, as in the film")
        self._view.on_update(lambda _: self._turn())
        self._pause = gui.add_button("Pause")
        self._pause.on_click(lambda _: self._toggle())
        self._another = gui.add_button("New episode")
        self._another.on_click(lambda _: self._want("episode", self.wanted.episode + 1))
        self._seek = gui.add_slider(
            "time, s", min=0.0, max=self._end_s, step=CONTROL_DT_S * STRIDE, initial_value=0.0
        )
        self._seek.on_update(self._on_seek)
        self._sought_s: float | None = None
        self._now = gui.add_markdown("")
        self._note = gui.add_markdown("", order=1000)

    def _want(self, name: str, value: Any) -> None:
        value = value % EPISODES if name == "episode" else value
        self.wanted = replace(self.wanted, **{name: value})

    def _toggle(self) -> None:
        self.playing = not self.playing
        self._pause.label = "Pause" if self.playing else "Play"

    def _on_seek(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # a hand, not the loop below
            self._sought_s = self._seek.value

    def _turn(self) -> None:
        """Every visitor's camera to the chosen view."""
        close_up = self._close_up()
        for client in self.server.get_clients().values():
            aim(client, close_up or overview(2, phone=_is_phone(client)))

    def _close_up(self) -> View | None:
        """Of the tableau that is chosen; None: the overview is."""
        shown = len(self.take.poses) if self.take else 0
        i = min(VIEWS.index(self._view.value), shown)
        return self._goals[i - 1] if i else None

    @property
    def _end_s(self) -> float:
        return CONTROL_DT_S * self._config.env.episode_steps

    def prepare(self, choice: Choice) -> None:
        """Simulate a choice and set the page up for it; minutes of nothing are announced."""
        self._said.content = (
            f"**Busy: simulating {choice.who}, delay {choice.delay}, sea {choice.sea}.** "
            "A new controller or delay is compiled first: 15 s to a minute."
        )
        for control in (*self._choices.values(), self._another):
            control.disabled = True
        self.server.flush()
        try:
            take = self._simulate(choice)
        finally:
            for control in (*self._choices.values(), self._another):
                control.disabled = False
        self._surface = surface(take, self._config.motion, take.time_s[::STRIDE])
        self.take = take
        self.tableaux[1].root.visible = len(take.poses) > 1
        self._add_plots(take)
        self._note.content = (
            f"{self._surface.note} Its spectrum is the motion's; ripples finer than 0.6 m are left "
            "out. The hulls are drawn smaller than the 2.55 m ones whose motion this is: those "
            "would overlap at the task's distance. Thick axes: goal; thin and pale: tool."
            if not self._config.motion.motion
            else self._surface.note
        )
        self._said.content = self._headline(choice, take)

    def _simulate(self, choice: Choice) -> Take:
        env = self.env.with_delay(choice.delay)
        return simulate(
            env,
            choice.who,
            self._menu.controller(choice.who, choice.delay),
            sea=env.motion.seas.index(choice.sea),
            seed=self._config.seed,
            episode=choice.episode,
        )

    def _headline(self, choice: Choice, take: Take) -> str:
        means = "; ".join(
            f"{who} {1e3 * poses.pos_error_m.mean():.2f} mm, "
            f"{1e3 * poses.ang_error_rad.mean():.2f} mrad"
            for who, poses in zip(take.names, take.poses, strict=True)
        )
        trained = self._menu.trained_for.get(choice.who)
        strange = trained and not set(choice.delay.split(",")) <= set(trained.split(","))
        warning = f" **Trained for {trained}.**" if strange else ""
        return (
            f"Delay {take.delay}, sea {describe_sea(take.sea)} at full scale, model 1:10, episode "
            f"{choice.episode}. Mean errors: {means}.{warning}"
        )

    def _add_plots(self, take: Take) -> None:
        for plot in self._plots:
            plot.remove()
        self._plots = [
            ErrorPlot(self.server, take, [1e3 * p.pos_error_m for p in take.poses], "position, mm"),
            ErrorPlot(
                self.server, take, [1e3 * p.ang_error_rad for p in take.poses], "orientation, mrad"
            ),
        ]

    def show(self, frame: int, *, whole: bool = False) -> None:
        """One instant of the take.

        Args:
            whole: with what follows only every few pictures while it plays: plots, numbers, slider.
        """
        assert self.take is not None and self._surface is not None
        step, take = frame * STRIDE, self.take
        water_m = self.stage.water_m(
            self._surface, frame, take.poses[0], step, *self.tableaux[0].points_m
        )
        with self.server.atomic():
            goals = []
            for name, poses, tableau in zip(take.names, take.poses, self.tableaux, strict=False):
                self.stage.place(poses, step)
                tableau.place(self.stage)
                tableau.set_water(water_m)
                goals.append(tableau.close_up(self.stage))
                tableau.label.text = f"{_title(name)}: {1e3 * poses.pos_error_m[step]:.1f} mm"
            self._goals = goals
            if whole or frame % PLOT_EVERY == 0:
                self._show_numbers(take, step)
        if self._close_up():
            self._turn()

    def _show_numbers(self, take: Take, step: int) -> None:
        for plot in self._plots:
            plot.mark(float(take.time_s[step]))
        rows = [
            f"| {_title(name)} | {1e3 * p.pos_error_m[step]:.2f} "
            f"| {1e3 * p.ang_error_rad[step]:.2f} |"
            for name, p in zip(take.names, take.poses, strict=True)
        ]
        self._now.content = "\n".join(["| now | mm | mrad |", "|---|---|---|", *rows])
        self._seek.value = round(CONTROL_DT_S * step, 3)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until `stop()` or an interrupt: follow the controls, play, begin again at the end."""
        shown: Choice | None = None
        now_s, last = 0.0, time.monotonic()
        while not stop():
            fresh = self.wanted != shown
            if fresh:
                shown, now_s = self.wanted, 0.0
                self._prepare_or_say(shown)
                self._sought_s, last = None, time.monotonic()
            assert self.take is not None
            elapsed_s, last = time.monotonic() - last, time.monotonic()
            sought, self._sought_s = self._sought_s, None
            if sought is not None:
                now_s = sought
            elif self.playing:
                now_s = (now_s + elapsed_s) % self._end_s
            frames = -(-self.take.steps // STRIDE)
            asked = fresh or sought is not None
            if self.playing or asked:
                self.show(min(int(now_s / (STRIDE * CONTROL_DT_S)), frames - 1), whole=asked)
            time.sleep(STRIDE * CONTROL_DT_S)

    def _prepare_or_say(self, choice: Choice) -> None:
        """What cannot be shown is said on the page, which stays; the first time it is raised."""
        try:
            self.prepare(choice)
        except UserError as error:
            if self.take is None:
                raise
            self._said.content = f"**Not shown: {error}.** The episode before is still there."


class Menu:
    """The controllers to choose from: what `evaluate` takes by name, and the one asked for. Loaded
    and fitted when they are chosen."""

    def __init__(self, config, entry):
        """Args: as `Player`'s."""
        self._config = config
        shipped = sorted(f"{SHIPPED}{p.stem}" for p in asset_path("policies").glob("*.npz"))
        self.names = tuple(dict.fromkeys([entry.label, *WHO, *shipped]))
        self.trained_for = {entry.label: entry.settings.get("delay")}
        self._loaded: dict[tuple[str, str], Any] = {}
        self._loaded[self._key(entry.label, config.env.delay)] = entry.controller

    def _key(self, who: str, delay: str) -> tuple[str, str]:
        return who, delay if who in FITTED else ""

    def controller(self, who: str, delay: str) -> Any:
        """By its name in the menu; one that is fitted is fitted for this delay.

        Raises:
            UserError: it cannot be loaded.
        """
        key = self._key(who, delay)
        if key not in self._loaded:
            (entry,) = load_entries([who])
            self.trained_for[who] = entry.settings.get("delay")
            env = replace(self._config.env, delay=delay)
            fitted = fit_if_needed(who, entry.controller, env, self._config.motion, "")
            self._loaded[key] = fitted
        return self._loaded[key]


class ErrorPlot:
    """Errors over a whole episode, and a line where it is now."""

    def __init__(self, server: viser.ViserServer, take: Take, errors: list[np.ndarray], title: str):
        """
        Args:
            errors: (steps,) of each controller.
            title: what it is, with its unit.
        """
        self._time_s = take.time_s[::STRIDE]
        self._errors = [x[::STRIDE].astype(float) for x in errors]
        self._top = float(1.1 * max(np.nanquantile(x, 0.999) for x in errors))
        series: list[Any] = [{"label": "s"}]
        for name, colour in palette.controllers(take.names).items():
            series.append({"label": _title(name), "stroke": colour, "width": 2})
        series.append({"label": "now", "stroke": MUTED, "width": 1})
        self._plot = server.gui.add_uplot(
            data=self._data(self._time_s[0]),
            series=tuple(series),
            title=title,
            scales={
                "x": {"time": False, "auto": False, "range": (0.0, float(take.time_s[-1]))},
                "y": {"auto": False, "range": (0.0, self._top)},
            },
            legend={"show": False},
            aspect=2.2,
        )

    def _data(self, now_s: float) -> tuple[np.ndarray, ...]:
        """Time and errors, an instant twice in them: the ends of the line."""
        at = int(np.searchsorted(self._time_s, now_s - 1e-9))
        line = np.full(len(self._time_s) + 1, np.nan)
        line[at : at + 2] = 0.0, self._top
        return *(np.insert(x, at, x[at]) for x in (self._time_s, *self._errors)), line

    def mark(self, now_s: float) -> None:
        """Move the line."""
        self._plot.data = self._data(now_s)

    def remove(self) -> None:
        """Take it off the page."""
        self._plot.remove()


def _title(name: str) -> str:
    return "IK baseline" if name == "ik" else name


def _is_phone(client: viser.ClientHandle) -> bool:
    return client.camera.image_width < PHONE_PX


def _leave_room(client: viser.ClientHandle) -> None:
    """On a phone the panel is a sheet over half of the picture."""
    if _is_phone(client):
        aim(client, overview(2, phone=True))


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
