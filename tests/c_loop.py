"""The whole closed loop without JAX: a NumPy policy steers C MuJoCo's arm on a moving base.

Written anew where that is short (motion from scipy's Hermite spline, IK from MuJoCo's Jacobian,
filter from scipy), in float64: a second opinion on the environment, not a copy of it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import moving_base
import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.spatial.transform import Rotation

from mcx_jax.config.delay import Delay

H_S, SUBSTEPS, KNOT_STEPS, KNOT_S = 0.002, 10, 50, 0.1
START_RAD = np.array([-0.1, -1.0, 2.4, -2.9, -1.5, 0.0])
REST_B_M, REST_B = np.array([0.65, 0.0, 0.0]), Rotation.from_rotvec([0.0, 0.0, np.pi])
GOAL_TURN = Rotation.from_rotvec(np.pi * np.sqrt(0.5) * np.array([1.0, 1.0, 0.0]))


@dataclass(frozen=True)
class Window:
    """Motion of both vessels in an episode: knots (rows, 12), and the step where it begins."""

    knots_a: np.ndarray
    start_a: int
    knots_b: np.ndarray
    start_b: int
    goal_m: np.ndarray


def poses(knots: np.ndarray, steps: np.ndarray) -> list[np.ndarray]:
    """x y z m, roll pitch yaw rad and two derivatives by time, (T, 6) each, at physics steps."""
    first, last = steps[0] // KNOT_STEPS, steps[-1] // KNOT_STEPS + 2
    rows = np.asarray(knots[first:last], np.float64)
    spline = CubicHermiteSpline(np.arange(first, last), rows[:, :6], KNOT_S * rows[:, 6:])
    return [spline(steps / KNOT_STEPS, k) / KNOT_S**k for k in range(3)]


def base_rates(rpy: np.ndarray, rate: np.ndarray, acc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) angular velocity and acceleration in body axes of R = Rz Ry Rx."""
    roll, pitch = (Rotation.from_euler(axis, rpy[:, [k]]) for k, axis in enumerate("xy"))
    axes = [
        np.broadcast_to([1.0, 0.0, 0.0], rpy.shape),
        roll.inv().apply([0.0, 1.0, 0.0]),
        (pitch * roll).inv().apply([0.0, 0.0, 1.0]),
    ]
    w, al = np.zeros_like(rpy), np.zeros_like(rpy)
    for k, axis in enumerate(axes):
        # In the body, this axis turns with the rates of the axes nearer to it, the other way round.
        al += axis * acc[:, k : k + 1] - np.cross(w, axis * rate[:, k : k + 1])
        w += axis * rate[:, k : k + 1]
    return w, al


class Arm:
    """C MuJoCo's arm, on a fixed base for kinematics and on a free one for dynamics."""

    def __init__(self, path: str) -> None:
        self.fixed = mujoco.MjModel.from_xml_path(path)
        self.free = moving_base.free_base_model(path)
        self.data = mujoco.MjData(self.fixed)
        self.implicit = self.fixed.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.is_position = self.fixed.actuator_biasprm[:, 1] != 0
        self.joint = self.fixed.actuator_trnid[:, 0]
        self.site = self.fixed.site("tool").id

    def tool(self, q: np.ndarray) -> np.ndarray:
        """(4, 4) pose of the tool in the base; leaves the kinematics of q in `data`."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.fixed, self.data)
        pose = np.eye(4)
        pose[:3, :3] = self.data.site_xmat[self.site].reshape(3, 3)
        pose[:3, 3] = self.data.site_xpos[self.site]
        return pose

    def inverse(self, q: np.ndarray, target: np.ndarray, iterations: int) -> np.ndarray:
        """Joint angles near q that bring the tool to a (4, 4) pose: damped least squares."""
        jacobian = np.zeros((6, 6))
        for _ in range(iterations):
            tool = self.tool(q)
            mujoco.mj_comPos(self.fixed, self.data)
            mujoco.mj_jacSite(self.fixed, self.data, jacobian[:3], jacobian[3:], self.site)
            turn = Rotation.from_matrix(target[:3, :3] @ tool[:3, :3].T).as_rotvec()
            e = np.concatenate([target[:3, 3] - tool[:3, 3], turn])
            far = np.linalg.norm(e[:3]) + np.linalg.norm(e[3:]) > 0.1
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 3e-2 * far * np.eye(6), e)
            q = q + step * min(1.0, 2.0 / np.linalg.norm(step))
        return q

    def advance(self, q, qd, reference, rate, base):
        """One physics step; base = (R_I_B, w, al, linear acceleration) as `moving_base`."""
        ctrl = np.where(self.is_position, reference[self.joint], rate[self.joint])
        stiff = 0.0
        if self.implicit:
            stiff = moving_base.implicit_damping(self.fixed, q, qd, ctrl)
        qd = qd + H_S * moving_base.acceleration(self.free, q, qd, ctrl, *base, stiff)
        return q + H_S * qd, qd


def late(delay: Delay, first: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The delay, settled on a first joint reference: one control step a call."""
    queue = deque([first] * delay.steps)
    if delay.order:
        sos = butter(delay.order, delay.cutoff_hz / 25.0, output="sos")
        memory = [sosfilt_zi(sos)[:, :, None] * first]

    def apply(reference: np.ndarray) -> np.ndarray:
        queue.append(reference)
        reference = queue.popleft()
        if delay.order:
            (reference,), memory[0] = sosfilt(sos, reference[None], axis=0, zi=memory[0])
        return reference

    return apply


def goals(window: Window, steps: np.ndarray) -> np.ndarray:
    """(T, 4, 4) the goal in the arm's base."""
    a, b = (
        poses(knots, start + steps)[0]
        for knots, start in ((window.knots_a, window.start_a), (window.knots_b, window.start_b))
    )
    r_a = Rotation.from_euler("xyz", a[:, 3:])
    r_b = REST_B * Rotation.from_euler("xyz", b[:, 3:])
    pose = np.tile(np.eye(4), (len(steps), 1, 1))
    pose[:, :3, :3] = (r_a.inv() * r_b * GOAL_TURN).as_matrix()
    pose[:, :3, 3] = r_a.inv().apply(REST_B_M + b[:, :3] + r_b.apply(window.goal_m) - a[:, :3])
    return pose


def episode(
    arm: Arm, delay: Delay, window: Window, act: Callable, aim: Callable, count: int
) -> np.ndarray:
    """An episode of `count` control steps.

    Args:
        act: (T_B_G, T_B_E) -> action.
        aim: (T_B_G, action) -> T_B_H.

    Returns:
        (count, 2) distance (m) and angle (rad) between tool and goal after every step.
    """
    goal = goals(window, SUBSTEPS * np.arange(count + 1))
    x, xd, xdd = poses(window.knots_a, window.start_a + np.arange(SUBSTEPS * count))
    deck = Rotation.from_euler("xyz", x[:, 3:]).as_matrix()
    w, al = base_rates(x[:, 3:], xd[:, 3:], xdd[:, 3:])
    reference = arm.inverse(START_RAD, goal[0], 12)
    q, qd, rest = reference, np.zeros(6), np.zeros(6)
    for _ in range(100):
        q, qd = arm.advance(q, qd, reference, rest, (deck[0], rest[:3], rest[:3], rest[:3]))
    delayed, errors = late(delay, reference), []
    for k in range(count):
        action = act(goal[k], arm.tool(q))
        old, reference = reference, delayed(arm.inverse(q, aim(goal[k], action), 4))
        rate = (reference - old) / (SUBSTEPS * H_S) if k else rest
        for i in range(SUBSTEPS * k, SUBSTEPS * (k + 1)):
            q, qd = arm.advance(q, qd, reference, rate, (deck[i], w[i], al[i], xdd[i, :3]))
        tool = arm.tool(q)
        turn = Rotation.from_matrix(goal[k + 1, :3, :3].T @ tool[:3, :3])
        apart = goal[k + 1, :3, 3] - tool[:3, 3]
        errors.append([np.linalg.norm(apart), turn.magnitude()])
    return np.array(errors)
