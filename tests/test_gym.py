"""Gymnasium environments: the checker, one against many against the task itself, autoreset, the
library's own wrappers one by one, pictures."""

import dataclasses
import sys
import types
from importlib.util import find_spec
from typing import get_type_hints

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import blank, off_screen_opengl
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.envs.v2v import make_env
from mcx_jax.errors import UserError
from mcx_jax.integrations import gym

STEPS = 12
# implicitfast chatters less: rounding is not amplified as much as by Euler.
QUIET = {"delay": "E2", "sea": "Wd", "integrator": "implicitfast", "episode_steps": STEPS}
MANY = 3
SMALL = 0.03
"""Actions, cm and crad: 0.3, drawn anew every step, drives servos to their torque limits, where
rounding grows to 2e-4 m within a dozen steps."""
# Other fusions, other roundings (float32, poses of 1 m, a dozen steps); errors in mm and mrad.
CLOSE, CLOSE_MILLI = 2e-5, 2e-2


@pytest.fixture(scope="module")
def one():
    return gymnasium.make(gym.ENV_ID, **QUIET)


@pytest.fixture(scope="module")
def many():
    return gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, **QUIET)


def actions(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-SMALL, SMALL, (count, MANY, 6)).astype(np.float32)


def assert_same(got, want, name=""):
    """Gymnasium's results: arrays, numbers, and infos of them with the same keys."""
    if isinstance(want, dict):
        assert set(got) == set(want), name
        for key in want:
            assert_same(got[key], want[key], f"{name} {key}")
    elif isinstance(want, np.ndarray) and want.dtype == object:
        assert [x is None for x in got] == [x is None for x in want], name
        for a, b in zip(got, want, strict=True):
            if b is not None:
                assert_same(a, b, name)
    else:
        atol = CLOSE_MILLI if name.endswith(("dp_mm", "da_mrad")) else CLOSE
        np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=name)


# Positions have no bound that holds for any arm; actions are in cm and crad, not in units of 10.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*recommend using a symmetric and normalized space")
def test_gymnasium_accepts_it(one):
    check_env(one.unwrapped)


def test_spaces(one, many):
    assert one.observation_space.shape == (38,) and one.action_space.shape == (6,)
    assert one.observation_space.dtype == one.action_space.dtype == np.float32
    np.testing.assert_array_equal(one.action_space.low, -5.0)
    np.testing.assert_array_equal(one.action_space.high, 5.0)
    assert many.observation_space.shape == (MANY, 38) and many.action_space.shape == (MANY, 6)
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = many.reset(seed=0)
    assert obs in many.observation_space
    obs, reward, terminated, truncated, info = many.step(many.action_space.sample())
    assert obs in many.observation_space and obs.flags.writeable
    assert reward.shape == terminated.shape == truncated.shape == (MANY,)
    assert terminated.dtype == truncated.dtype == info["valid"].dtype == bool


@pytest.mark.parametrize(
    "mode",
    [AutoresetMode.SAME_STEP, pytest.param(AutoresetMode.NEXT_STEP, marks=pytest.mark.slow)],
)
def test_many_are_gymnasiums_own_vector_of_single_ones(mode):
    single = lambda: gymnasium.make(gym.ENV_ID, **QUIET)  # noqa: E731
    theirs = SyncVectorEnv([single] * MANY, autoreset_mode=mode)
    many = gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, autoreset_mode=mode.value, **QUIET)
    for got, want in zip(many.reset(seed=5), theirs.reset(seed=5), strict=True):
        assert_same(got, want, "reset")
    ends = []
    for i, action in enumerate(actions(2 * STEPS + 2)):
        got, want = many.step(action), theirs.step(action)
        for name, a, b in zip(("obs", "reward", "end", "cut", "info"), got, want, strict=True):
            assert_same(a, b, f"step {i}: {name}")
        ends.append(got[3])
    late = int(mode is AutoresetMode.NEXT_STEP)
    assert np.flatnonzero(np.all(ends, axis=1)).tolist() == [STEPS - 1, 2 * STEPS - 1 + late]
    assert np.sum(ends) == 2 * MANY


def test_against_the_task(one):
    env_config = EnvConfig(delay="E2", integrator="implicitfast", episode_steps=STEPS)
    env = make_env(env_config, MotionConfig(sea="Wd"), split="train")
    reset = jax.jit(lambda env, key: env.reset(key))
    step = jax.jit(lambda env, state, action: env.step(state, action))
    for episode in range(2):
        obs, info = one.reset(seed=11) if episode == 0 else one.reset()
        state = reset(env, jax.random.fold_in(jax.random.key(11), episode))
        assert_same(obs, np.asarray(state.obs))
        for i, action in enumerate(actions(STEPS, seed=episode)[:, 0]):
            obs, reward, terminated, truncated, info = one.step(action)
            state = step(env, state, jnp.asarray(action))
            assert_same(obs, np.asarray(state.obs))
            dp_m, da_rad = state.metrics.pos_error_m, state.metrics.ang_error_rad
            assert reward == pytest.approx(-float(dp_m + da_rad), abs=CLOSE)
            assert_same(
                info, {"dp_mm": 1e3 * float(dp_m), "da_mrad": 1e3 * float(da_rad), "valid": True}
            )
            assert (terminated, truncated) == (False, i == STEPS - 1)


def test_final_observation_is_the_old_episodes(many):
    many.reset(seed=2)
    for action in actions(STEPS):
        obs, reward, _, truncated, info = many.step(action)
    assert truncated.all()
    final = np.stack(info["final_obs"])
    # Entries 36 and 37 are dp and da, which the reward is made of.
    np.testing.assert_allclose(-final[:, 36:].sum(1), reward, rtol=1e-5)
    np.testing.assert_allclose(info["final_info"]["dp_mm"], 1e3 * final[:, 36], rtol=1e-5)
    np.testing.assert_allclose(info["dp_mm"], 1e3 * obs[:, 36], rtol=1e-5)
    assert np.abs(final[:, 9:12] - obs[:, 9:12]).max(1).min() > 1e-3  # another goal


def test_seeds(many):
    first, _ = many.reset(seed=7)
    second, _ = many.reset()
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(many.reset(seed=7)[0], first)
    np.testing.assert_array_equal(many.reset()[0], second)
    np.testing.assert_array_equal(many.reset(seed=[9, 7, None])[0][1], first[0])
    np.testing.assert_array_equal(many.reset(seed=8)[0][:-1], first[1:])


def test_training_and_test_motion_differ(one):
    other = gymnasium.make(gym.ENV_ID, test=True, **QUIET)
    assert not np.allclose(one.reset(seed=1)[0], other.reset(seed=1)[0])


def test_compiled_once(many):
    many.reset(seed=0)
    many.step(actions(1)[0])
    sizes = gym._reset._cache_size(), gym._step._cache_size()
    for action in actions(STEPS):  # one reset among them
        many.step(action)
    many.reset(seed=[4, None, 6])
    assert (gym._reset._cache_size(), gym._step._cache_size()) == sizes


def test_a_diverged_environment_is_cut_and_never_shown(many):
    """One of three gets a state that is not finite in the middle of its episode."""
    many.reset(seed=3)
    before = many.step(actions(1)[0])
    episodes = many.unwrapped._episodes
    arm = episodes.state.arm
    bad = dataclasses.replace(arm, q=arm.q.at[:, 1].set(jnp.nan))
    episodes.state = dataclasses.replace(episodes.state, arm=bad)
    obs, reward, terminated, truncated, info = many.step(actions(1)[0])
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    assert info["final_info"]["valid"].tolist() == [False, False, False]
    assert info["final_info"]["_valid"].tolist() == [False, True, False]
    np.testing.assert_array_equal(info["final_obs"][1], before[0][1])
    assert reward[1] == before[1][1]
    assert np.isfinite(obs).all() and np.isfinite(reward).all() and info["valid"].all()
    obs, _, _, truncated, _ = many.step(actions(1)[0])
    assert np.isfinite(obs).all() and not truncated.any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dely": "E2"}, "unknown setting 'dely': use test or a field of EnvConfig, Conditions"),
        ({"noise_mm": 1}, "setting noise_mm is 1, must be of type str"),
        ({"noise_mm": "loud"}, "--noise-mm loud: use a number from 0 to 1000"),
        ({"noise_mm": "1", "conditions": ConditionsConfig()}, "conditions and noise_mm: give one"),
        ({"test": "no"}, "setting test is 'no', must be of type bool"),
        ({"render_mode": "ansi"}, "render_mode 'ansi': use rgb_array or None"),
        ({"max_episode_steps": 0}, "max_episode_steps 0: must be positive, or -1 for none"),
        ({"max_episode_steps": 2000}, "2000, but an episode has episode_steps 1000: give both"),
        (
            {"max_episode_steps": 1000, "episode_steps": 1500},
            "Gymnasium cuts .* at .* 1000: give both",
        ),
        ({"delay": "F2"}, "unknown delay 'F2'"),
        ({"delay": 2}, "setting delay is 2, must be of type str"),
        ({"physics": "MJX"}, "setting physics is 'MJX', must be one of chain, mjx"),
        ({"split": "Paper"}, "setting split is 'Paper', must be one of seeds, paper"),
        ({"autoreset_mode": "Disabled"}, "autoreset_mode 'Disabled': use SameStep or NextStep"),
        ({"num_envs": 0}, "num_envs 0: must be a positive integer"),
    ],
)
def test_mistakes(settings, message):
    with pytest.raises(UserError, match=message):
        gym.V2VVector(**settings)


BAD_ACTIONS = [
    (np.zeros((1, 6)), r"action of shape \(1, 6\): must have shape \(6,\), cm and crad"),
    (np.zeros(5), r"action of shape \(5,\): must have shape \(6,\)"),
    (np.full(6, np.nan), "action is NaN or infinite: must be finite numbers"),
    (np.full(6, np.inf), "action is NaN or infinite"),
    ("left", r"action: must be an array of numbers, shape \(6,\)"),
    ([[0.0], [0.0, 0.0]], "action: must be an array of numbers"),
]


@pytest.mark.parametrize(("action", "message"), BAD_ACTIONS)
def test_a_wrong_action_is_refused_in_one_line(one, action, message):
    one.reset(seed=0)
    with pytest.raises(UserError, match=message) as error:
        one.unwrapped.step(action)
    assert "\n" not in str(error.value)


def test_a_wrong_action_among_many_is_refused(many):
    many.reset(seed=0)
    with pytest.raises(UserError, match=r"action of shape \(6,\): must have shape \(3, 6\)"):
        many.step(np.zeros(6))
    poisoned = np.zeros((MANY, 6))
    poisoned[1, 2] = np.nan
    with pytest.raises(UserError, match="action is NaN"):
        many.step(poisoned)


def test_options_of_a_reset_are_refused_not_ignored(one, many):
    for env in (one, many):
        with pytest.raises(UserError, match="reset takes no options, not 'sea'"):
            env.reset(options={"sea": "Wa"})


def test_every_setting_is_taken_by_its_plain_name():
    """Each field of the three dataclasses lands where the dataclass has it."""
    values = {
        "noise_mm": "1",
        "latency_steps": "0:2",
        "sea": "Wb",
        "split": "paper",
        "goal": "circle",
    }
    read = gym._read(True, dict(values))
    assert read.env.conditions == ConditionsConfig(noise_mm="1", latency_steps="0:2")
    assert (read.motion, read.split) == (MotionConfig(sea="Wb", split="paper"), "test")
    assert read.env.goal == "circle"
    for config in (ConditionsConfig, EnvConfig, MotionConfig):
        for name in get_type_hints(config):
            read = gym._read(False, {name: getattr(config(), name)})
            assert (read.env, read.motion) == (EnvConfig(), MotionConfig()), name


def test_the_age_of_late_measurements_is_in_the_observation():
    late = gymnasium.make(gym.ENV_ID, latency_steps="2", **QUIET)
    assert late.observation_space.shape == (39,)


def test_the_registered_spec_has_gymnasiums_time_limit():
    assert gymnasium.spec(gym.ENV_ID).max_episode_steps == EnvConfig().episode_steps == 1000
    assert gymnasium.make(gym.ENV_ID, **QUIET).spec.max_episode_steps == 1000
    short = gymnasium.make(gym.ENV_ID, max_episode_steps=7, **QUIET)
    assert short.spec.max_episode_steps == 7


def test_gymnasiums_time_limit_ends_the_episodes_of_many_too():
    limited = gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, max_episode_steps=7, **QUIET)
    limited.reset(seed=0)
    ends = [limited.step(action)[3].all() for action in actions(STEPS)]
    assert np.flatnonzero(ends).tolist() == [6]


def test_an_episode_cut_at_the_registered_limit_is_not_taken_for_a_whole_one():
    long = gym.V2V(**(QUIET | {"episode_steps": 1500}))
    long._taken = 1000  # as after Gymnasium's TimeLimit
    with pytest.raises(UserError, match="give both, max_episode_steps=1500"):
        long.reset()


def test_mistakes_in_seeds(many):
    with pytest.raises(UserError, match="2 seeds for 3 environments"):
        many.reset(seed=[1, 2])
    with pytest.raises(UserError, match="must be 0 to 2"):
        many.reset(seed=2**32 - 1)


WRAPPERS = {
    "AddRenderObservation": lambda env: wrappers.AddRenderObservation(env, render_only=True),
    "AddWhiteNoise": lambda env: wrappers.AddWhiteNoise(env, probability_of_noise_per_pixel=0.5),
    "Autoreset": wrappers.Autoreset,
    "ClipAction": wrappers.ClipAction,
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.1, 0.0),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, delay=1),
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, bins=3, multidiscrete=True),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float64),
    "FlattenObservation": wrappers.FlattenObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "GrayscaleObservation": lambda env: wrappers.GrayscaleObservation(
        wrappers.AddRenderObservation(env, render_only=True)
    ),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, skip=2),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "ObstructView": lambda env: wrappers.ObstructView(env, 0.5, 8),
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "RecordVideo": lambda env: wrappers.RecordVideo(env, "films"),
    "RenderCollection": wrappers.RenderCollection,
    "RepeatAction": lambda env: wrappers.RepeatAction(env, num_repeats=2),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, -1.0, 1.0),
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(env, (2, 19)),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 5),
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda a: 0.5 * a, None),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda x: -x, None),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda r: 10 * r),
}
VECTOR_WRAPPERS = {
    "ClipAction": wrappers.vector.ClipAction,
    "ClipReward": lambda env: wrappers.vector.ClipReward(env, -0.1, 0.0),
    "DictInfoToList": wrappers.vector.DictInfoToList,
    "DtypeObservation": lambda env: wrappers.vector.DtypeObservation(env, np.float64),
    "FlattenObservation": wrappers.vector.FlattenObservation,
    "NormalizeObservation": wrappers.vector.NormalizeObservation,
    "NormalizeReward": wrappers.vector.NormalizeReward,
    "RecordEpisodeStatistics": wrappers.vector.RecordEpisodeStatistics,
    "RecordVideo": lambda env: wrappers.vector.RecordVideo(env, "films"),
    "RescaleAction": lambda env: wrappers.vector.RescaleAction(env, -1.0, 1.0),
    "ReshapeObservation": lambda env: wrappers.vector.ReshapeObservation(env, (2, 19)),
    "TransformAction": lambda env: wrappers.vector.TransformAction(env, lambda a: 0.5 * a),
    "TransformObservation": lambda env: wrappers.vector.TransformObservation(env, lambda x: -x),
    "TransformReward": lambda env: wrappers.vector.TransformReward(env, lambda r: 10 * r),
    "VectorizeTransformAction": lambda env: wrappers.vector.VectorizeTransformAction(
        env, wrappers.ClipAction
    ),
    "VectorizeTransformObservation": lambda env: wrappers.vector.VectorizeTransformObservation(
        env, wrappers.FlattenObservation
    ),
    "VectorizeTransformReward": lambda env: wrappers.vector.VectorizeTransformReward(
        env, wrappers.TransformReward, func=abs
    ),
}
if find_spec("pygame"):
    WRAPPERS["HumanRendering"] = wrappers.HumanRendering
    VECTOR_WRAPPERS["HumanRendering"] = wrappers.vector.HumanRendering
NOT_OURS = {
    "ArrayConversion": "environments that return other arrays",
    "AtariPreprocessing": "Atari",
    "DiscretizeObservation": "bounded observations",
    "FilterObservation": "observations that are dictionaries",
    "HumanRendering": "the package pygame",
    "JaxToNumpy": "environments that return JAX arrays",
    "JaxToTorch": "environments that return JAX arrays, and torch",
    "NumpyToTorch": "the package torch",
    "RescaleObservation": "bounded observations",
    "ResizeObservation": "the package cv2",
    "vector": "not a wrapper",
}
"""What the other wrappers of the library are for, or need."""


def test_no_wrapper_of_the_library_is_forgotten():
    assert set(wrappers.__all__) <= set(WRAPPERS) | set(NOT_OURS)
    vector = set(wrappers.vector.__all__) - {"GrayscaleObservation"}  # of images
    assert vector <= set(VECTOR_WRAPPERS) | set(NOT_OURS)


class Clip:
    """Stand-in for moviepy's: its releases (2.2.1) refuse Pillow 12 and later, which viz brings."""

    saved: list["Clip"]

    def __init__(self, frames, fps):
        self.frames, self.fps = frames, fps

    def write_videofile(self, path, logger):
        self.path = path
        self.saved.append(self)


@pytest.fixture
def films(monkeypatch, tmp_path):
    """What RecordVideo has saved."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    for name in ("moviepy", "moviepy.video", "moviepy.video.io"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    clip = types.ModuleType("moviepy.video.io.ImageSequenceClip")
    clip.__dict__["ImageSequenceClip"] = Clip
    monkeypatch.setitem(sys.modules, clip.__name__, clip)
    monkeypatch.setattr(Clip, "saved", [], raising=False)
    return Clip.saved


@pytest.fixture(scope="module")
def opengl():
    off_screen_opengl()


@pytest.fixture(scope="module")
def pictured(opengl):
    """The bare environment: one renderer for all its wrappers."""
    env = gym.V2V(render_mode="rgb_array", **QUIET)
    env.spec = gymnasium.spec(gym.ENV_ID)
    yield env
    env.close()


def fake_pictures(monkeypatch):
    """Wrappers are tried with pictures that cost nothing; the next tests draw real ones."""
    picture = np.zeros((360, 640, 3), np.uint8)
    monkeypatch.setattr(gym.Episodes, "pictures", lambda self: (picture,) * len(self.seeds))


# The library's own, of its own arrays.
@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*recommend using a symmetric and normalized space")
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_of_gymnasium_take_it(name, monkeypatch, films):
    fake_pictures(monkeypatch)
    inner = gymnasium.make(gym.ENV_ID, render_mode="rgb_array", **QUIET)
    env = WRAPPERS[name](inner)
    obs, _ = env.reset(seed=1)
    assert obs in env.observation_space
    env.action_space.seed(0)
    for _ in range(2):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert obs in env.observation_space and np.isfinite(reward)
        assert not terminated and not truncated
    env.render()
    env.close()
    assert [(film.fps, len(film.frames)) for film in films] == [(50, 3)] * (name == "RecordVideo")


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
@pytest.mark.parametrize("name", VECTOR_WRAPPERS)
def test_vector_wrappers_of_gymnasium_take_it(name, monkeypatch, films):
    fake_pictures(monkeypatch)
    settings = QUIET | {"render_mode": "rgb_array", "autoreset_mode": "NextStep"}
    env = VECTOR_WRAPPERS[name](gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, **settings))
    obs, _ = env.reset(seed=1)
    assert obs in env.observation_space
    env.action_space.seed(0)
    for _ in range(2):
        obs, reward, terminated, truncated, _ = env.step(0.01 * env.action_space.sample())
        assert obs in env.observation_space and np.isfinite(reward).all()
        assert not terminated.any() and not truncated.any()
    assert len(env.render()) == MANY
    env.close()
    assert [(film.fps, len(film.frames)) for film in films] == [(50, 3)] * (name == "RecordVideo")


def test_time_aware_observations_end_with_the_steps_left():
    env = wrappers.TimeAwareObservation(
        gymnasium.make(gym.ENV_ID, max_episode_steps=STEPS, **QUIET), normalize_time=True
    )
    env.reset(seed=0)
    last = [env.step(action)[0][-1] for action in actions(STEPS)[:, 0]]
    np.testing.assert_allclose(last, np.arange(1, STEPS + 1) / STEPS)


def test_pictures_are_of_the_episode_that_is_stepped(pictured):
    pictured.reset(seed=1)
    first, again = pictured.render(), pictured.render()
    assert first.shape == (360, 640, 3) and first.dtype == np.uint8 and not blank(first)
    np.testing.assert_array_equal(first, again)
    for action in actions(STEPS)[:, 0]:
        pictured.step(action)
    assert np.abs(pictured.render().astype(int) - first).mean() > 0.5  # the clock, the sea, the arm
    assert gym.V2V(**QUIET).render() is None


@pytest.mark.slow
def test_pictures_of_many_are_those_of_single_ones(opengl, pictured):
    settings = QUIET | {"render_mode": "rgb_array"}
    many = gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, **settings)
    many.reset(seed=1)
    pictures = many.render()
    assert len(pictures) == MANY
    pictured.reset(seed=2)
    # Other fusions, other roundings: a pixel at an edge may turn.
    assert np.abs(pictures[1].astype(int) - pictured.render()).mean() < 0.05
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 1
    many.close()


def test_without_opengl_render_is_refused_in_one_line_and_the_rest_works(monkeypatch):
    from mcx_jax.play import gl

    monkeypatch.setattr(gl, "choose", lambda: "glide")
    env = gym.V2V(render_mode="rgb_array", **QUIET)
    env.reset(seed=0)
    env.step(np.zeros(6))
    with pytest.raises(UserError, match=r"^off-screen OpenGL \(glide\) fails: No module"):
        env.render()


def test_render_needs_the_extra_viz(monkeypatch):
    monkeypatch.setattr(gym, "find_spec", lambda name: None)
    env = gym.V2V(render_mode="rgb_array", **QUIET)
    env.reset(seed=0)
    with pytest.raises(UserError, match="render needs pillow: pip install 'mcx_jax"):
        env.render()
