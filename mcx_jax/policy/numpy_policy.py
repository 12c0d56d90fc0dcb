"""A trained policy in NumPy alone: copy this one file aboard, beside an exported policy `.npz`.

    policy = Policy("policy.npz")
    policy.reset()                                    # whenever tracking begins
    action = policy.step(observation(T_B_G, T_B_E))   # every 20 ms
    aim = corrected_goal(T_B_G, action)               # T_B_H: where to bring the tool

Frames: B the arm's base, E the tool, G the goal. A pose T_B_G is a (4, 4) matrix that maps
coordinates in G (m) to coordinates in B. The file is made by `python -m mcx_jax.export`.
"""

import json

import numpy as np


class Policy:
    """A policy that acts, one observation at a time. `interface` says what goes in and out (names,
    order, units, frames, delay trained for); `state` is its memory {name: (H,) float32}."""

    def __init__(self, path) -> None:
        with np.load(path, allow_pickle=False) as file:
            if "interface" not in file.files:
                raise ValueError(f"{path}: not an exported policy; use python -m mcx_jax.export")
            arrays = {name: file[name] for name in file.files}
        self.interface = json.loads(str(arrays["interface"]))
        if self.interface["cell"] not in CELLS:
            raise ValueError(f"{path}: this runs {', '.join(CELLS)}, not {self.interface['cell']}")
        self._advance = CELLS[self.interface["cell"]]
        normal = self.interface["normalisation"]
        self._mean, self._clip = arrays["obs/mean"], normal["clip"]
        self._std = np.maximum(np.sqrt(arrays["obs/var"]), np.float32(normal["std_floor"]))
        part = lambda name, *of: [arrays[f"policy/net/{name}/{x}"] for x in of]  # noqa: E731
        self._layers = [part(x, "kernel", "bias") for x in ("dense_0", "dense_1", "head")]
        self._cell = part("cell", "input_kernel", "recurrent_kernel", "bias")
        self.reset()

    def reset(self) -> None:
        """Forget: an episode, or tracking, begins."""
        self.state = {k: np.zeros(n, np.float32) for k, n in self.interface["state"].items()}

    def step(self, observed) -> np.ndarray:
        """Raw observation (38,), (39,) with its age in s -> action (6,), cm, crad; advances memory.

        Raises:
            ValueError: wrong length, or a number that is not finite; the memory stays as it was.
        """
        observed = np.asarray(observed)
        if observed.shape != self._mean.shape or not np.isfinite(observed).all():
            raise ValueError(f"observation: {self._mean.size} finite numbers are needed")
        x = np.clip((observed - self._mean) / self._std, -self._clip, self._clip)
        x = x.astype(np.float32)
        for kernel, bias in self._layers[:2]:
            x = np.tanh(x @ kernel + bias)
        self.state = self._advance(x, self.state, *self._cell)
        kernel, bias = self._layers[2]
        return (x + self.state["h"]) @ kernel + bias


def observation(T_B_G, T_B_E) -> np.ndarray:
    """(38,) observation from the poses of goal and tool, (4, 4) each, in m."""
    goal, tool = np.asarray(T_B_G, np.float64), np.asarray(T_B_E, np.float64)
    relative = goal[:3, :3].T @ tool[:3, :3]
    apart = goal[:3, 3] - tool[:3, 3]
    skew = 0.5 * np.array([relative[i, j] - relative[j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    # atan2, not arccos, which near 1 resolves no angle of the size of the errors here.
    angle = np.arctan2(np.linalg.norm(skew), 0.5 * (np.trace(relative) - 1.0))
    poses = [x for pose in (goal, tool) for x in (pose[:3, :3].ravel(), pose[:3, 3])]
    return np.concatenate([*poses, relative.ravel(), apart, [np.linalg.norm(apart), angle]])


def corrected_goal(T_B_G, action) -> np.ndarray:
    """(4, 4) pose to bring the tool to: the goal moved and turned in its own axes by an action."""
    goal, (x, y, z) = np.array(T_B_G, np.float64), 0.01 * np.asarray(action[3:], np.float64)
    turn, t = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.sqrt(x * x + y * y + z * z)
    a, b = np.sinc(t / np.pi), 0.5 * np.sinc(t / (2 * np.pi)) ** 2  # sin t / t, (1 - cos t) / t^2
    goal[:3, 3] += goal[:3, :3] @ (0.01 * np.asarray(action[:3], np.float64))
    goal[:3, :3] = goal[:3, :3] @ (np.eye(3) + a * turn + b * turn @ turn)
    return goal


def _lstm(x, state, w_x, w_h, bias) -> dict:
    i, f, g, o = np.split(x @ w_x + state["h"] @ w_h + bias, 4)  # input, forget, cell, output
    c = _sigmoid(f) * state["c"] + _sigmoid(i) * np.tanh(g)
    return {"c": c, "h": _sigmoid(o) * np.tanh(c)}


def _gru(x, state, w_x, w_h, bias) -> dict:
    new, old = np.split(x @ w_x + bias, 3), np.split(state["h"] @ w_h, 3)
    reset, update = _sigmoid(new[0] + old[0]), _sigmoid(new[1] + old[1])
    candidate = np.tanh(new[2] + reset * old[2])
    return {"h": candidate + update * (state["h"] - candidate)}


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)  # no overflow for large |x|


CELLS = {"lstm": _lstm, "gru": _gru}
