"""When training has stopped to learn: no checkpoint of it, and an end with the states that led
there.

An iteration is lost when nothing was learned from it: every window left out, or every step of a
network (metric `lost` of the trainers). One may be bad luck; `LIMIT` in a row are not.
"""

import json
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mcx_jax.compute import processes
from mcx_jax.config.training import TrainConfig
from mcx_jax.errors import UserError, reason
from mcx_jax.policy.networks import step
from mcx_jax.policy.normalise import normalise_obs
from mcx_jax.ppo.trainer import networks_of
from mcx_jax.runs import checkpoint
from mcx_jax.runs.progress import LEFT_OUT
from mcx_jax.runs.run_dir import RunDir

LIMIT = 10
"""Lost iterations in a row that end a run."""


@dataclass
class Watch:
    """Counts lost iterations, those that metrics.jsonl has already and those it is told of."""

    run: RunDir
    lost: int = 0
    """Lost iterations in a row, up to now."""
    before: Any = None
    """A copy of the state before an iteration that may be the last."""

    def __post_init__(self) -> None:
        """Where the run goes on from."""
        rows, seeds = self.run.last_rows(LIMIT), self.run.config.seeds
        for k in range(0, len(rows), seeds):
            self._count(rows[k : k + seeds])

    def before_iteration(self, state: Any) -> None:
        """Copy the state before the iteration donates its buffers, if it may be the last."""
        if self.lost == LIMIT - 1:
            self.before = jax.tree.map(jnp.copy, state)

    def after_iteration(self, state: Any, rows: list[dict[str, Any]]) -> None:
        """Told of what came of it.

        Raises:
            UserError: `LIMIT` lost iterations in a row.
        """
        self._count(rows)
        if self.lost >= LIMIT:
            row = next(row for row in rows if row["lost"])
            self._stop(
                state,
                rows,
                f"nothing was learned in {LIMIT} iterations in a row (in the last one "
                f"{100 * row['rejected_share']:.0f} % of the {LEFT_OUT[self.run.config.algo]} were "
                f"left out, {row['skipped_updates']:.0f} updates skipped, "
                f"{row['reset_envs']:.0f} environments reset)",
            )

    def check(self, state: Any, rows: list[dict[str, Any]]) -> None:
        """Refuse to save weights or statistics that are not finite.

        Raises:
            UserError: they are not.
        """
        flat = checkpoint.flatten(state.replace(actors=None))
        bad = [path for path, x in flat.items() if not np.isfinite(jax.device_get(x)).all()]
        if bad:
            self._stop(state, rows, f"{bad[0]} is not finite")

    def _count(self, rows: list[dict[str, Any]]) -> None:
        self.lost = self.lost + 1 if any(row["lost"] for row in rows) else 0

    def _stop(self, state: Any, rows: list[dict[str, Any]], why: str) -> None:
        where, last = self.run.path, checkpoint.latest(self.run.path)
        good = f"the checkpoint of iteration {last} is kept" if last else "there is no checkpoint"
        path = where / f"diverged-{rows[0]['iteration']}.npz"
        try:
            arrays = states(self.run.config, self.before, state)
            if self.run.writes and not path.exists():
                np.savez(path, allow_pickle=False, rows=json.dumps(rows), **arrays)
            dump = f"the states are in {path}"
        except OSError as error:
            dump = f"the states could not be written ({reason(error)})"
        raise UserError(
            f"{where}: stopped at iteration {rows[0]['iteration']}: {why}; {good}, {dump}; "
            "start another run with a smaller step size or another --seed"
        )


def states(config: TrainConfig, before: Any, after: Any) -> dict[str, np.ndarray]:
    """What is dumped: `before.` and `after.` the last iteration every leaf of the state (weights,
    memories, environments with their observations) and `action`, the mean action of the policy
    there, (N, A), a seed axis in front where there are several. Without `before`: `after` alone."""

    def action(state: Any) -> jax.Array:
        params, memory = state.learner.policy.params, state.actors.policy_carry
        nets = networks_of(config.ppo, params["params"]["raw_sigma"].shape[-1])
        seen = normalise_obs(state.obs_stats, state.actors.env_state.obs.T)
        return step(nets.policy, params, memory, seen)[1]

    act = jax.vmap(action) if config.seeds > 1 else action
    flat = {}
    for name, state in (("before", before), ("after", after)):
        if state is not None:
            flat[f"{name}.action"] = act(state)
            flat |= {name + path: leaf for path, leaf in checkpoint.flatten(state).items()}
    return processes.whole(flat)
