"""What every GMI of a serving job knows: its part of the work, and who else there is."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax

from gmijax.collection.policy import ActingPolicy
from gmijax.collection.programs import Keep
from gmijax.collection.shards import ShardWriter
from gmijax.config import ServeConfig
from gmijax.partition.child import ChildLink
from gmijax.sim.wrappers import BatchedEnv, BatchState, env_keys


class Share(NamedTuple):
    """One GMI's part of a serving job.

    Attributes:
      config: of the job.
      link: to the controller.
      env: the environments; an agent uses their sizes only.
      policy: who acts.
      rank: place among the GMIs that simulate (an agent: among the agents).
      first_unroll: unrolls that earlier jobs have written of this GMI's part.
      num_unrolls: unrolls that are left to be made.
      writer: takes the experience, None where it is not kept.
      meet: returns when all GMIs of the job have called it.
    """

    config: ServeConfig
    link: ChildLink
    env: BatchedEnv
    policy: ActingPolicy
    rank: int
    first_unroll: int
    num_unrolls: int
    writer: ShardWriter | None
    meet: Callable[[], None]

    @property
    def keep(self) -> Keep:
        """What of every step leaves the compiled program."""
        return Keep(self.writer is not None, self.config.output.next_obs)

    @property
    def steps_per_unroll(self) -> int:
        """N T, environment steps of one unroll of one GMI."""
        return self.config.envs_per_gmi * self.config.unroll_length

    def reset(self) -> BatchState:
        """Environments at their starts.

        Starts depend on the seed, on the number of the environment in the whole job, and on how
        many unrolls were there before: a job that goes on makes other episodes, not the same.
        """
        key = jax.random.fold_in(jax.random.key(self.config.seed), self.first_unroll)
        keys = env_keys(key, self.rank * self.config.envs_per_gmi, self.config.envs_per_gmi)
        return jax.jit(self.env.init)(self.env.model, keys)
