"""Play: what is drawn is what was simulated, the page serves, a film has its frames."""

import contextlib
import dataclasses
import math
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from browser import off_screen_opengl, tab

from mcx_jax import extras
from mcx_jax.arm import ik
from mcx_jax.config.delay import CONTROL_DT_S, SUBSTEPS
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.controllers.classical import CLASSICAL
from mcx_jax.envs import vessels
from mcx_jax.envs.motion import Track
from mcx_jax.envs.v2v import make_env
from mcx_jax.errors import UserError
from mcx_jax.evaluate import errors_beside_ik
from mcx_jax.play import gl
from mcx_jax.play.__main__ import PlayConfig, main
from mcx_jax.play.episode import EPISODES, describe_sea, simulate
from mcx_jax.play.renderer import Painter, Stage
from mcx_jax.play.scene import FREEBOARD_M, below_decks_m
from mcx_jax.play.video import STRIDE, title
from mcx_jax.play.waves import surface
from mcx_jax.sea.hydro import VesselKnobs
from mcx_jax.sea.spectrum import GRAVITY_M_S2, parse_sea
from mcx_jax.sea.tables import component_grid, inverse_fft, table_seed, wave_amplitudes
from mcx_jax.spatial import unpack

STEPS, EPISODE, SEED = 60, 2, 4
# implicitfast chatters less than Euler: rounding grows little.
TASK = EnvConfig(delay="E1,E2", integrator="implicitfast", episode_steps=STEPS)
MOTION = MotionConfig(sea="Wd")


@pytest.fixture(scope="module")
def env():
    return make_env(TASK, MOTION, split="test")


@pytest.fixture(scope="module")
def take(env):
    return simulate(env, "extrapolate", CLASSICAL["extrapolate"], sea=0, seed=SEED, episode=EPISODE)


@pytest.mark.slow
def test_an_episode_is_evaluates(env, take):
    both = errors_beside_ik(
        "extrapolate", CLASSICAL["extrapolate"], env, episodes=EPISODES, seed=SEED
    )
    assert take.names == ("ik", "extrapolate") and take.sea == "Wd"
    key = jax.random.split(jax.random.key(SEED), EPISODES)[EPISODE]
    drawn = int(env.draw(key)[2].delay)
    assert take.delay == ("E1 (20 ms)", "E2 (40 ms)")[drawn]
    for errors, poses in zip(both, take.poses, strict=True):
        np.testing.assert_allclose(poses.pos_error_m, errors.pos_m[:, 0, EPISODE], atol=2e-5)
        np.testing.assert_allclose(poses.ang_error_rad, errors.ang_rad[:, 0, EPISODE], atol=2e-5)


@pytest.mark.parametrize("step", [0, 31, STEPS - 1])
def test_drawn_is_simulated(env, take, step):
    """Tool and goal on the stage, seen from the drawn arm's base, against the environment's."""
    stage = Stage(TASK)
    for poses in take.poses:
        stage.place(poses, step)
        data = stage.data
        base = data.body("arm/base")
        to_base = base.xmat.reshape(3, 3).T

        def seen(rotation, position_m, to_base=to_base, base=base):
            return to_base @ rotation.reshape(3, 3), to_base @ (position_m - base.xpos)

        tool = seen(data.site("arm/tool").xmat, data.site("arm/tool").xpos)
        goal = seen(data.body("goal").xmat, data.body("goal").xpos)
        marker = seen(data.body("tool").xmat, data.body("tool").xpos)
        track = Track(*(jnp.int32(x[0]) for x in (poses.seed, poses.start_a, poses.start_b)))
        # The goal's place on vessel B, from the drawn vessel; then all by the environment's code.
        deck = data.body("vessel_b")
        goal_m = deck.xmat.reshape(3, 3).T @ (data.body("goal").xpos - deck.xpos)
        wanted_goal = vessels.goal_pose(
            env.motion, track, jnp.asarray(goal_m, jnp.float32), jnp.int32(SUBSTEPS * (step + 1))
        )
        wanted_tool = ik.tool_pose(env.model, unpack(jnp.asarray(poses.q_rad[step]), 6))
        for drawn, wanted in ((tool, wanted_tool), (marker, wanted_tool), (goal, wanted_goal)):
            np.testing.assert_allclose(drawn[0], np.array(wanted[0]), atol=1e-5)
            np.testing.assert_allclose(drawn[1], np.array(wanted[1]), atol=1e-5)
        assert np.all(goal_m > np.array(vessels.GOAL_LOW_M) - 1e-5)
        assert np.all(goal_m < np.array(vessels.GOAL_HIGH_M) + 1e-5)
        apart_m = np.linalg.norm(tool[1] - goal[1])
        assert apart_m == pytest.approx(poses.pos_error_m[step], abs=1e-5)


def test_surface_is_the_motions_waves(take):
    """At a knot and at a place off midship: the tables' own inverse FFT of the shifted waves."""
    knobs = VesselKnobs()
    start_s = take.window_starts_s[0]
    knot = math.ceil(10 * start_s)
    made = surface(take, MotionConfig(sea="Wd", coupled=True), np.array([knot / 10 - start_s]))
    sea = parse_sea("Wd")
    waves = wave_amplitudes(sea, table_seed(sea, "test", 0), knobs)
    omega = component_grid()[1]
    heading = math.radians(knobs.heading_deg)
    for x_m, y_m in ((0.4, 0.0), (-0.9, 0.3), (1.8, -2.0)):
        # Full scale; the deck origin is 4 m aft of midship.
        full_m = math.cos(heading) * (10 * x_m - 4) + math.sin(heading) * 10 * y_m
        elevation = inverse_fft(waves * np.exp(1j * omega**2 / GRAVITY_M_S2 * full_m))[0] / 10
        drawn = made.elevation_m(0, np.array([x_m]), np.array([y_m]))
        # Linear interpolation over 6 cm.
        assert drawn[0] == pytest.approx(elevation[knot], abs=2e-3)


@pytest.mark.parametrize("coupled", [False, True])
def test_vessels_ride_the_waves_that_are_drawn(coupled):
    """In long waves the deck's heave follows the surface below it, not another place or time."""
    motion = MotionConfig(sea="Wd", coupled=coupled)
    env = make_env(EnvConfig(episode_steps=1000), motion, split="test")
    from mcx_jax.play.episode import Poses, Take, vessel_poses

    starts = jnp.int32(70_000), jnp.int32(70_000 if coupled else 1_100_000)
    track = Track(jnp.int32(0), *starts)
    steps = SUBSTEPS * jnp.arange(1, 1001)
    (_, p_a), (_, p_b) = jax.vmap(lambda step: vessel_poses(env.motion, track, step))(steps)
    fill = dict.fromkeys(Poses.__dataclass_fields__)
    seed, *windows = (np.full(1000, x) for x in (0, *map(int, starts)))
    fill |= {"seed": seed, "start_a": windows[0], "start_b": windows[1], "pos_error_m": seed}
    take = Take(("ik",), (Poses(**fill),), "E1", "Wd")
    made = surface(take, motion, take.time_s)
    # At the deck origins the surface is each vessel's own.
    for heave_m, x_m in ((p_a[2], 0.0), (p_b[2], 0.65)):
        at = np.array([x_m]), np.array([0.0])
        elevation_m = np.array([made.elevation_m(i, *at)[0] for i in range(1000)])
        assert np.corrcoef(np.asarray(heave_m), elevation_m)[0, 1] > 0.85
    assert made.profiles_m.std() == pytest.approx(0.25 / 4, rel=0.2)


@pytest.mark.parametrize("roll_deg", [0, 8])
def test_no_deck_is_awash_in_a_sea_higher_than_the_hulls(roll_deg):
    """The drawn water at the hulls gives way, at the decks' places and tilts; elsewhere it does
    not."""
    angle = math.radians(roll_deg)
    roll = np.array(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )
    decks = [
        (np.array([0.0, 0.1, 0.05]), roll),
        (np.array([0.65, 0.0, -0.05]), np.diag([-1.0, -1.0, 1.0]) @ roll),
    ]
    along, across = np.meshgrid(np.linspace(-1.35, 0.24, 30), np.linspace(-0.35, 0.35, 15))
    for position, rotation in decks:
        deck = position[:, None] + rotation @ np.stack(
            [along.ravel(), across.ravel(), 0 * along.ravel()]
        )
        high = np.full(deck[2].shape, 0.5)
        drawn = below_decks_m(high, deck[0], deck[1], decks)
        # The corners of the round end lie outside the hull.
        hull = (along.ravel() > -1) | (np.hypot(along + 1, across).ravel() < 0.35)
        assert np.max((drawn - deck[2])[hull]) < -FREEBOARD_M + 1e-6
    far = np.array([3.5, 0.3]), np.array([0.0, 1.4])
    np.testing.assert_array_equal(below_decks_m(np.full(2, 0.4), *far, decks), 0.4)
    np.testing.assert_array_equal(below_decks_m(np.full(2, -0.2), *far[::-1], decks), -0.2)


def test_calm_water_for_a_recording(take):
    made = surface(take, MotionConfig(motion="log.csv"), take.time_s)
    assert not made.profiles_m.any() and "calm" in made.note


def refused(argv, message):
    with pytest.raises(UserError) as error:
        main(argv)
    assert str(error.value) == message


def test_refusals(tmp_path, monkeypatch):
    refused(["nobody"], "unknown controller 'nobody': use ik, extrapolate, extrapolate-best, "
            "fir, preview, shipped:DELAY, a run directory or a policy .npz")  # fmt: skip
    wrong = [
        (["--video", "a.avi"], "--video a.avi: the file's name must end in .mp4"),
        (["--frame", "a.jpg"], "--frame a.jpg: the file's name must end in .png"),
        (["--video", f"{tmp_path}/no/a.mp4"], f"--video {tmp_path}/no/a.mp4: no such directory"),
        (["--video", "a.mp4", "--frame", "a.png"], "--video and --frame: one at a time"),
        (["--frame", "a.png", "--at", "21"], "--at 21: the episode is 20 s long; 0 to 20"),
        (["--port", "0"], "--port 0: must be 1 to 65535"),
        (["--episode", "50"], "--episode 50: must be 0 to 49"),
        (["--seed", "-1"], "--seed -1: must be 0 or a positive integer"),
    ]
    for argv, message in wrong:
        refused(["ik", *argv], message)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    install = extras.install("viz")
    refused(["ik"], f"play needs viser: {install}")
    refused(["ik", "--frame", "a.png"], f"play needs pillow: {install}")


def test_the_close_up_does_not_cover_the_tool():
    """Goals all over vessel B's square, moved by as much as the roughest sea does."""
    from mcx_jax.play import picture

    model = Stage(TASK).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    at_m, axes = data.camera("pair").xpos, data.camera("pair").xmat.reshape(3, 3)
    x, y, z = np.meshgrid([0.45, 0.85], [-0.2, 0.2], [0.0, 0.45])
    right, up, back = axes.T @ (np.stack([x.ravel(), y.ravel(), z.ravel()]) - at_m[:, None])
    width = (picture.WIDTH_PX - picture.GAP_PX) / 2
    half_fovy = math.radians(float(model.camera("pair").fovy[0]) / 2)
    across_px = width / 2 + picture.PANEL_PX / 2 / math.tan(half_fovy) * right / -back
    assert np.all(across_px < width - 10 - picture.CLOSE_UP_PX), across_px


@pytest.mark.parametrize("camera", ["hero", "pair"])
def test_scale_bars_are_as_long_as_what_they_stand_for(take, camera):
    """Two points 0.5 m apart at the goal, across the picture, through a pinhole camera."""
    stage = Stage(TASK)
    stage.place(take.poses[0], 0)
    seen, goal_m = stage.data.camera(camera), stage.data.body("goal").xpos
    right, up, back = seen.xmat.reshape(3, 3).T
    focal_px = 215 / math.tan(math.radians(float(stage.model.camera(camera).fovy[0])) / 2)
    ends = [goal_m - seen.xpos, goal_m + 0.5 * right - seen.xpos]
    across_px = [focal_px * (right @ end) / -(back @ end) for end in ends]
    fake = SimpleNamespace(stage=stage)
    drawn_px = 0.5 * Painter.wide_px_per_m(fake, 430, camera)  # pyright: ignore
    assert drawn_px == pytest.approx(across_px[1] - across_px[0], rel=1e-6)


def test_a_films_title_has_the_seas_numbers_and_the_scale(take):
    assert title(take).endswith("|  sea Wd (Hs 2.5 m, Tp 10 s), model 1:10")
    assert describe_sea("3.0:11-coupled") == "3.0:11-coupled (Hs 3 m, Tp 11 s)"
    assert describe_sea("motion") == "recorded"


def test_no_opengl_is_one_line(monkeypatch):
    monkeypatch.setattr(gl, "_TRY", "raise SystemExit(1)")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    gl._first_that_draws.cache_clear()  # an answer of this process; an error is not kept
    with pytest.raises(UserError, match=r"^no off-screen OpenGL .* libosmesa6 .* libegl1 "):
        gl.choose()


def command(*argv):
    """A process as a user starts it: the suite itself must not touch OpenGL."""
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    return [sys.executable, "-m", "mcx_jax.play", *argv], environment


@pytest.mark.slow
def test_film_has_its_frames_and_something_in_them(tmp_path, repo_root):
    import imageio_ffmpeg as ffmpeg

    off_screen_opengl()
    path = tmp_path / "film.mp4"
    argv, environment = command("extrapolate", "--video", str(path), "--episode-steps", "12")
    done = subprocess.run(
        argv, env=environment, cwd=repo_root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.endswith(f"done: {path}, 6 frames, 25 a second\n")
    assert [x.name for x in tmp_path.iterdir()] == ["film.mp4"]
    read = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(path)]
    read += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(read, capture_output=True, check=True).stdout
    frames = np.frombuffer(raw, np.uint8).reshape(6, 720, 1280, 3)
    for frame in frames:
        left, right = frame[50:470, :630], frame[50:470, 650:]
        assert left.std() > 20 and right.std() > 20
    # The clock, the sea and the curves move.
    assert np.abs(frames[5].astype(int) - frames[0]).mean() > 0.5


@pytest.fixture(scope="module")
def player():
    from mcx_jax.play.player import Player
    from mcx_jax.report.entries import load_entries

    config = PlayConfig(who="extrapolate", port=18080, env=TASK, motion=MotionConfig())
    player = Player(config, *load_entries(["extrapolate"]))
    yield player
    player.stop()


def rounds(count):
    """A `stop` for `Player.run`."""
    left = iter(range(count))
    return lambda: next(left, None) is None


@pytest.mark.slow
def test_page_answers_and_builds_the_scene(player):
    with urllib.request.urlopen(player.url, timeout=20) as answer:
        assert answer.status == 200 and b"<html" in answer.read()[:2000].lower()
    player.prepare(player.wanted)
    player.show(STEPS // 2 - 1)
    step = STEPS - 2
    assert player.take.sea == "Wd"
    for poses, tableau in zip(player.take.poses, player.tableaux, strict=True):
        frames = {player.stage.model.body(k).name: v for k, v in tableau._frames.items()}
        np.testing.assert_allclose(frames["vessel_b"].position, poses.b_m[step], atol=1e-6)
        np.testing.assert_allclose(frames["goal"].position, poses.goal_m[step], atol=1e-6)
        apart_m = np.linalg.norm(np.subtract(frames["tool"].position, frames["goal"].position))
        assert apart_m == pytest.approx(poses.pos_error_m[step], abs=1e-5)
    assert "own window" in player._note.content
    assert "Wd (Hs 2.5 m, Tp 10 s) at full scale, model 1:10" in player._said.content


def test_the_menu_is_evaluates():
    """Names of `evaluate`, every shipped policy, and each of them loads."""
    from mcx_jax.controllers.by_name import FITTED, WHO
    from mcx_jax.play.player import Menu
    from mcx_jax.report.entries import load_entries

    menu = Menu(PlayConfig(who="ik", env=TASK), *load_entries(["ik"]))
    assert set(WHO) < set(menu.names)
    assert {"shipped:B4_4", "shipped:E0", "shipped:robust"} < set(menu.names)
    for name in menu.names:
        if name not in FITTED:  # minutes
            assert menu.controller(name, "E1") is not None, name
    assert menu.trained_for["shipped:E2"] == "E2"


@pytest.mark.slow
def test_the_time_line_and_the_errors_are_where_the_slider_is(player):
    """While it is paused, too, and at pictures that are no multiple of PLOT_EVERY."""
    player.prepare(player.wanted)
    player.show(7, whole=True)
    step = 7 * STRIDE
    assert player._seek.value == pytest.approx(CONTROL_DT_S * step)
    for plot, name, unit in zip(
        player._plots, ("pos_error_m", "ang_error_rad"), ("mm", "mrad"), strict=True
    ):
        time_s, *errors, line = plot._plot.data
        assert np.flatnonzero(np.isfinite(line)).tolist() == [7, 8]
        np.testing.assert_allclose(time_s[7:9], player.take.time_s[step])
        for drawn, poses in zip(errors, player.take.poses, strict=True):
            wanted = 1e3 * getattr(poses, name)[::STRIDE]
            np.testing.assert_allclose(np.delete(drawn, 7), wanted, err_msg=unit)
    shown = [f"{1e3 * p.ang_error_rad[step]:.2f} |" for p in player.take.poses]
    assert all(text in player._now.content for text in shown)


def test_the_close_up_has_the_goal_in_the_middle(player):
    player.prepare(player.wanted)
    player.show(3, whole=True)
    poses = player.take.poses[1]
    position, target = player.tableaux[1].close_up(player.stage)
    np.testing.assert_allclose(target, poses.goal_m[3 * STRIDE] + [0, -1.9, 0], atol=1e-6)
    assert np.linalg.norm(np.subtract(position, target)) == pytest.approx(0.24)
    assert position[2] < target[2]  # from below


def test_every_drawn_geom_is_in_the_page(player):
    """The browser's meshes are where MuJoCo has its geoms: their middles and extents agree."""
    from mcx_jax.play.page import _shape

    model = player.stage.model
    for geom in range(model.ngeom):
        if model.geom(geom).name == "sea" or model.geom_group[geom] > 2:
            continue
        shape = _shape(model, geom)
        middle = shape.bounds.mean(axis=0)
        np.testing.assert_allclose(middle, model.geom_pos[geom], atol=2e-3)
        radius = np.linalg.norm(shape.vertices - model.geom_pos[geom], axis=1).max()
        assert radius <= model.geom_rbound[geom] * 1.001 + 1e-6
        assert radius >= model.geom_rbound[geom] * 0.70


@pytest.mark.slow
def test_a_new_choice_is_shown_while_the_page_is_paused(player):
    player.run(rounds(2))
    player.playing = False
    try:
        for who, sea, episode in (("ik", "Wa", 3), ("extrapolate", "Wb", 4)):
            player.wanted = dataclasses.replace(player.wanted, who=who, sea=sea, episode=episode)
            player._seek.value = 0.6
            player.run(rounds(2))
            assert player.take.names[-1] == who and player.take.sea == sea
            assert f"episode {episode}" in player._said.content
            assert player.tableaux[1].root.visible == (who != "ik")
            assert player._seek.value == 0
            for poses, tableau in zip(player.take.poses, player.tableaux, strict=False):
                assert tableau.label.text.endswith(f": {1e3 * poses.pos_error_m[0]:.1f} mm")
                assert f"| {1e3 * poses.pos_error_m[0]:.2f} |" in player._now.content
    finally:
        player.playing = True


def test_what_cannot_be_loaded_is_said_on_the_page_which_stays(player, monkeypatch):
    player.run(rounds(1))
    before = player.take

    def refuse(who, delay):
        raise UserError("this policy is of another world")

    monkeypatch.setattr(player._menu, "controller", refuse)
    player.wanted = dataclasses.replace(player.wanted, who="preview")
    player.run(rounds(2))
    assert player.take is before
    assert "Not shown: this policy is of another world" in player._said.content
    assert not player._another.disabled
    player.wanted = dataclasses.replace(player.wanted, who="extrapolate")


HARMLESS = ("THREE.Clock", "GPU stall due to ReadPixels", "GroupMarkerNotSet")
"""viser's own, and software WebGL's."""


@contextlib.contextmanager
def running(player):
    """The page's loop beside a browser."""
    over = threading.Event()
    loop = threading.Thread(target=player.run, args=(over.is_set,))
    loop.start()
    try:
        yield
    finally:
        over.set()
        loop.join()


def wait_until(page, condition, what):
    for _ in range(300):  # a busy machine, software WebGL
        if condition():
            return
        page.wait_for_timeout(200)
    raise AssertionError(f"not within a minute: {what}")


def choose(page, label, option):
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option, exact=True).click()


def test_a_browser_shows_the_page_and_its_controls_work(player, tmp_path):
    """Pause, another controller, another sea, close-up, new episode: by clicks; nothing in the
    console; the canvas is not blank."""
    player.playing = True
    player.wanted = dataclasses.replace(player.wanted, who="extrapolate", sea="Wd", episode=0)
    with running(player), tab(tmp_path / "profile", 800, 450) as opened:
        page = opened.page
        page.set_default_timeout(60_000)
        page.goto(player.url)
        page.get_by_role("button", name="Pause").click()
        wait_until(page, lambda: not player.playing, "paused")
        choose(page, "controller", "ik")
        wait_until(page, lambda: player.take.names == ("ik",), "the controller")
        choose(page, "sea", "Wa")
        wait_until(page, lambda: player.take.sea == "Wa", "the sea")
        page.get_by_role("button", name="New episode").click()
        wait_until(page, lambda: "episode 1" in player._said.content, "the episode")
        page.get_by_text("sea Wa (Hs 1 m, Tp 6 s)").wait_for()
        # Left of the panel, below the notice of software WebGL; viser fades the scene in.
        canvas = lambda: opened.picture()[200:, :480].astype(int)  # noqa: E731
        wait_until(page, lambda: canvas().std() > 30, "vessels on the canvas")
        overview = canvas()
        choose(page, "view", "close-up of controller")
        wait_until(page, lambda: near(player), "the camera's close-up")
        wait_until(page, lambda: np.abs(overview - canvas()).mean() > 10, "its picture")
        said = [x for x in opened.complaints if not any(known in x for known in HARMLESS)]
        assert said == []
    player.playing = True


def near(player):
    """Whether the visitor's camera is at the goal."""
    cameras = [client.camera for client in player.server.get_clients().values()]
    return any(np.linalg.norm(np.subtract(c.position, c.look_at)) < 0.3 for c in cameras)


def test_a_phone_has_the_vessels_above_the_panel(player, tmp_path):
    from mcx_jax.play.page import overview

    player.prepare(player.wanted)
    player.show(0, whole=True)
    with tab(tmp_path / "profile", 390, 800) as opened:
        opened.page.set_default_timeout(60_000)
        opened.page.goto(player.url)
        position, target = overview(2, phone=True)

        def far():
            cameras = [client.camera for client in player.server.get_clients().values()]
            return any(
                np.allclose([c.position, c.look_at], [position, target], atol=1e-3) for c in cameras
            )

        wait_until(opened.page, far, "the phone's camera")
        assert opened.sideways_px() == 0


def test_ctrl_c_ends_cleanly(repo_root):
    argv, environment = command("ik", "--port", "18181", "--episode-steps", "60")
    with subprocess.Popen(
        argv,
        env=environment,
        cwd=repo_root,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        watchdog = threading.Timer(300, process.kill)
        watchdog.start()
        assert process.stdout and process.stderr
        said = ""
        with contextlib.suppress(StopIteration):
            while "open http://127.0.0.1:" not in said:
                said += next(process.stdout)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate()
        watchdog.cancel()
    assert process.returncode == 0, err
    assert (out, err) == ("\nstopped\n", "")
    assert "viser" not in said


def test_sea_of_the_model_is_the_surface(take):
    from mcx_jax.play.scene import sea_points_m, water_level_m

    stage = Stage(TASK)
    made = surface(take, MOTION, take.time_s[:1])
    stage.set_sea(made, 0, take.poses[0], 0)
    model, field = stage.model, stage.model.hfield("sea")
    x_m, y_m = sea_points_m(model)
    row, column = 100, 37
    # MuJoCo's own reading of a height field: centre, half sizes, data times the range.
    height_m = model.geom("sea").pos[2] + field.size[2] * field.data[row, column]
    wanted_m = made.elevation_m(0, x_m[row, column], y_m[row, column])
    assert height_m - water_level_m(model) == pytest.approx(float(wanted_m), abs=1e-6)
    assert x_m[0, 0] < x_m[0, -1] and y_m[0, 0] < y_m[-1, 0]
    assert water_level_m(model) == pytest.approx(-0.21)
    assert model.geom_type[model.geom("sea").id] == mujoco.mjtGeom.mjGEOM_HFIELD
