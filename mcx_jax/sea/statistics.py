"""Motion statistics of a sea state: how fast the goal moves, seen from the arm's base.

The paper's table 1 lists, per sea state, the mean speed and the mean angular rate of the goal. The
generator is calibrated against these eight figures. The authors' recordings themselves are in their
repository (github.com/sherilan/exposed-mcx, `exposed/data`), without a licence: they are neither
shipped nor used here, and nothing here was compared with their spectra.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mcx_jax.sea.hydro import VesselKnobs, load_hydro, motion_rao
from mcx_jax.sea.spectrum import SeaState, jonswap, spreading_weights
from mcx_jax.sea.tables import FROUDE_LAMBDA, SEPARATION_X_M, MotionTables

WANTED_LINEAR_M_S = (0.068, 0.120, 0.155, 0.185)
"""Paper: mean linear speed of the goal, Wa..Wd, laboratory scale."""
WANTED_ANGULAR_RAD_S = (0.077, 0.085, 0.100, 0.110)
"""Paper: mean angular rate of the goal, Wa..Wd."""


@dataclass(frozen=True)
class GoalSpeed:
    """Means over random pairs of windows.

    Attributes:
        linear_m_s: (seas,) mean of |d/dt p|, p = goal position in base axes.
        angular_rad_s: (seas,) mean of |w|, w = angular velocity of the goal relative to the base.
    """

    linear_m_s: np.ndarray
    angular_rad_s: np.ndarray

    def log_errors(self) -> np.ndarray:
        """ln(here / paper): (2, 4), linear then angular; only for Wa..Wd in that order."""
        wanted = np.array([WANTED_LINEAR_M_S, WANTED_ANGULAR_RAD_S])
        return np.log(np.stack([self.linear_m_s, self.angular_rad_s]) / wanted)


def rotation(rpy: np.ndarray) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll): (n, 3) -> (n, 3, 3)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy).T, np.cos(rpy).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def body_rate(rpy: np.ndarray, rpy_rate: np.ndarray) -> np.ndarray:
    """Angular velocity in body axes: (n, 3), (n, 3) -> (n, 3)."""
    (sr, sp, _), (cr, cp, _) = np.sin(rpy).T, np.cos(rpy).T
    roll, pitch, yaw = rpy_rate.T
    return np.stack(
        [roll - yaw * sp, pitch * cr + yaw * cp * sr, -pitch * sr + yaw * cp * cr], axis=1
    )


def goal_speed(
    tables: MotionTables, pairs: int = 40_000, seed: int = 0, turned: bool = False
) -> GoalSpeed:
    """Mean speeds of the goal of every sea state.

    Both vessels take independent random instants of the sea's tables (with coupled tables: the same
    instant of table and companion); the goal is uniform in +-0.1 m, +-0.1 m, 0.1..0.3 m on B.

    Args:
        tables: motion at laboratory scale.
        pairs: random pairs per sea; 40,000 over 8 hours leave 0.3 % of chance in the means.
        seed: of the pairs and goals.
        turned: turn vessel B's translation with its 180 deg rest pose. The authors' code and the
            environment do not, so the default is False.
    """
    rng = np.random.default_rng(seed)
    linear, angular = [], []
    for sea in range(len(tables.sea_names)):
        rows = tables.knots[tables.sea_index == sea].reshape(-1, 12).astype(float)
        a = rng.integers(len(rows), size=pairs)
        if tables.companion is None:
            b_rows = rows[rng.integers(len(rows), size=pairs)]
        else:
            b_rows = tables.companion[tables.sea_index == sea].reshape(-1, 12)[a].astype(float)
        goal_m = rng.uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 0.3], size=(pairs, 3))
        speed, rate = _pair_speeds(rows[a], b_rows, goal_m, turned)
        linear.append(speed.mean())
        angular.append(rate.mean())
    return GoalSpeed(np.array(linear), np.array(angular))


def _pair_speeds(
    a: np.ndarray, b: np.ndarray, goal_m: np.ndarray, turned: bool
) -> tuple[np.ndarray, np.ndarray]:
    """|d/dt p_goal| in base axes and |w_goal - w_base|, for rows (n, 12) of A and B: (n,), (n,)."""
    half_turn = np.array([-1.0, -1.0, 1.0])
    side = half_turn if turned else np.ones(3)
    rot_a, rot_b = rotation(a[:, 3:6]), half_turn[:, None] * rotation(b[:, 3:6])
    rate_a = body_rate(a[:, 3:6], a[:, 9:12])  # base axes
    rate_b = np.einsum("nij,nj->ni", rot_b, body_rate(b[:, 3:6], b[:, 9:12]))  # world axes
    arm = np.einsum("nij,nj->ni", rot_b, goal_m)
    gap = np.array([SEPARATION_X_M, 0.0, 0.0]) + side * b[:, :3] + arm - a[:, :3]
    velocity = side * b[:, 6:9] + np.cross(rate_b, arm) - a[:, 6:9]
    in_base = np.einsum("nji,nj->ni", rot_a, velocity)
    position = np.einsum("nji,nj->ni", rot_a, gap)
    relative_rate = np.einsum("nji,nj->ni", rot_a, rate_b) - rate_a
    speed = np.linalg.norm(in_base - np.cross(rate_a, position), axis=1)
    return speed, np.linalg.norm(relative_rate, axis=1)


def linear_goal_speed(
    seas: Sequence[SeaState], knobs: VesselKnobs, samples: int = 6000
) -> GoalSpeed:
    """The same means from linear theory, without a table: 10 ms, within 2 % of `goal_speed`.

    The rates of a vessel at an instant are Gaussian with the covariance of the response spectrum;
    small angles. Fixed samples, so that a search over knobs sees a smooth function.
    """
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((2, samples, 6))
    arm = rng.uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 0.3], size=(samples, 3)) * [-1, -1, 1]
    goal = arm + [SEPARATION_X_M, 0.0, 0.0]
    omega, step = np.arange(0.2, 3.2, 0.02), 0.02
    theta, weight = spreading_weights(knobs.spreading, 13)
    raos = [motion_rao(knobs, knobs.heading_deg + angle) for angle in np.degrees(theta)]
    grid = load_hydro().omega
    rao = np.array([[np.interp(omega, grid, rao[:, dof]) for dof in range(6)] for rao in raos])
    rao[:, :3] /= FROUDE_LAMBDA
    linear, angular = [], []
    for sea in seas:
        rate_energy = jonswap(omega, sea, knobs.gamma) * step * omega**2 * FROUDE_LAMBDA
        covariance = np.einsum("d,dcw,dew,w->ce", weight, rao, rao.conj(), rate_energy).real
        # Exact head seas leave sway, roll and yaw without variance: keep the factor defined.
        a, b = normal @ np.linalg.cholesky(covariance + 1e-14 * np.eye(6)).T
        rate_b = b[:, 3:] * [-1, -1, 1]
        velocity = b[:, :3] + np.cross(rate_b, arm) - a[:, :3] - np.cross(a[:, 3:], goal)
        linear.append(np.linalg.norm(velocity, axis=1).mean())
        angular.append(np.linalg.norm(rate_b - a[:, 3:], axis=1).mean())
    return GoalSpeed(np.array(linear), np.array(angular))
