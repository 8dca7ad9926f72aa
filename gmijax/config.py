"""The configuration of a run: frozen dataclasses and their checks.

No hydra and no jax here. Default values live in `configs/`, meanings live here: `--help` prints
the `doc` of every field. `gmijax.schema.from_dict` makes them from outside data.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType
from typing import Literal

from gmijax.errors import ConfigError
from gmijax.randomization import LeafRange
from gmijax.schema import doc, require_at_least, require_between, require_positive

ADAPTIVE_LEARNING_RATE_RANGE = (1e-5, 1e-2)
"""Where the adaptive schedule keeps the learning rate, and so where it must begin."""


_EXAMPLES: Mapping[str, str] = MappingProxyType(
    {"brax": "ant", "playground": "CartpoleBalance", "custom": "path/to/cart.py:make"}
)


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The task."""

    # Whose task it is: env= sets it.
    suite: Literal["gmijax", "brax", "playground", "custom"] = "gmijax"
    name: str | None = doc(
        "name of the task; with env=brax or env=playground one of theirs (Playground downloads "
        "robot models at first use), with env=custom PATH.py:FUNCTION"
    )
    episode_length: int | None = doc(
        "steps after which an episode is truncated (time limit); null: the task's own"
    )
    # Digest of a custom task's file: the run itself notes it.
    source_sha256: str | None = None
    randomize: Literal["off", "on"] = doc(
        "whether every world has a physics model of its own, drawn from env.randomization",
        default="off",
    )
    randomization: Mapping[str, LeafRange] = dataclasses.field(
        default_factory=dict,
        metadata={"doc": "leaves of the physics model: operation, range, names, draw"},
    )

    def __post_init__(self) -> None:
        if self.name is None:
            example = _EXAMPLES.get(self.suite, "ant")
            raise ConfigError(
                f"env.name: must be given with env={self.suite}, e.g. env.name={example}"
            )
        if self.episode_length is not None:
            require_at_least("env.episode_length", self.episode_length, 1)
        for leaf, drawn in self.randomization.items():
            drawn.check(leaf)
        if self.randomize == "on" and not self.randomization:
            raise ConfigError("env.randomize=on: env.randomization names nothing to draw")

    @property
    def label(self) -> str:
        """What a task is called in files and messages: `ant`, `brax/ant`, `cart.py:make`."""
        if self.suite == "custom":
            return PurePath(str(self.name)).name
        return str(self.name) if self.suite == "gmijax" else f"{self.suite}/{self.name}"

    @property
    def slug(self) -> str:
        """The task in the name of a run folder: `ant`, `brax-ant`, `cart`."""
        if self.suite == "custom":
            return PurePath(self.label.rpartition(":")[0]).stem
        return self.label.replace("/", "-")


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The simulator."""

    impl: Literal["auto", "jax", "warp"] = doc("MJX implementation")


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Hyper-parameters of PPO, with Brax's names."""

    name: Literal["ppo"] = doc("training algorithm")
    unroll_length: int = doc("T, environment steps per environment and iteration")
    num_minibatches: int = doc("minibatches per pass over the rollout")
    num_updates_per_batch: int = doc("passes over the rollout (epochs)")
    discounting: float = doc("discount factor per step, 0 to 1")
    gae_lambda: float = doc("lambda of generalised advantage estimation, 0 to 1")
    clipping_epsilon: float = doc("clip range of the probability ratio")
    clip_value_loss: bool = doc("clip the value loss with clipping_epsilon too")
    value_cost: float = doc("weight of the value loss")
    entropy_cost: float = doc("weight of the entropy bonus")
    bound_cost: float = doc("weight of the penalty on action means outside [-1.1, 1.1]")
    learning_rate: float = doc("step size of Adam (the first one, if the schedule is adaptive)")
    learning_rate_schedule: Literal["fixed", "adaptive_kl"] = doc(
        "fixed, or steered to keep the policy's KL divergence per update near desired_kl"
    )
    desired_kl: float = doc("target of the adaptive schedule")
    max_grad_norm: float = doc("gradients are scaled down to this global norm")
    reward_scaling: float = doc("factor on rewards before learning (logged returns are unscaled)")
    normalize_observations: bool = doc("normalise observations with running statistics")
    normalize_advantage: bool = doc("normalise advantages over all samples of all GMIs")
    policy_hidden_layer_sizes: tuple[int, ...] = doc("widths of the policy network")
    value_hidden_layer_sizes: tuple[int, ...] = doc("widths of the value network")
    init_noise_std: float = doc("standard deviation of the first policy")

    def __post_init__(self) -> None:
        for key in ("unroll_length", "num_minibatches", "num_updates_per_batch"):
            require_at_least(f"algo.{key}", getattr(self, key), 1)
        for key in ("discounting", "gae_lambda"):
            require_between(f"algo.{key}", getattr(self, key), 0.0, 1.0)
        for key in ("value_cost", "entropy_cost", "bound_cost"):
            require_at_least(f"algo.{key}", getattr(self, key), 0.0)
        for key in (
            *("clipping_epsilon", "learning_rate", "desired_kl", "max_grad_norm"),
            *("reward_scaling", "init_noise_std"),
        ):
            require_positive(f"algo.{key}", getattr(self, key))
        for key in ("policy_hidden_layer_sizes", "value_hidden_layer_sizes"):
            for width in getattr(self, key):
                require_at_least(f"algo.{key}", width, 1)
        low, high = ADAPTIVE_LEARNING_RATE_RANGE
        if self.learning_rate_schedule == "adaptive_kl" and not low <= self.learning_rate <= high:
            raise ConfigError(
                f"algo.learning_rate={self.learning_rate!r}: must be between {low} and {high} "
                "with algo.learning_rate_schedule=adaptive_kl"
            )


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How the job is spread over GPUs."""

    gpus: int | tuple[int, ...] = doc("number of GPUs, or their indices as nvidia-smi lists them")
    gmis_per_gpu: int = doc("GMIs on every GPU")
    layout: tuple[tuple[int, ...], ...] | None = doc(
        "GMI ids of every GPU, e.g. [[0,1],[2]]; overrides gpus and gmis_per_gpu"
    )
    backend: Literal["auto", "mps", "mig", "share", "cpu"] = doc(
        "how a GMI gets its share of a GPU"
    )
    sm_percent: float | None = doc("cap on a GMI's share of SMs in percent (MPS); null: no cap")
    memory_fraction: float | None = doc(
        "fraction of a GPU's memory that each GMI reserves; null: 0.8 split evenly"
    )
    template: Literal["auto", "tcg_ex"] = doc("how roles map to GMIs")

    def __post_init__(self) -> None:
        if isinstance(self.gpus, int):
            require_at_least("plan.gpus", self.gpus, 1)
        elif not self.gpus or len(set(self.gpus)) != len(self.gpus) or min(self.gpus) < 0:
            raise ConfigError(
                f"plan.gpus={list(self.gpus)}: expected a number of GPUs or distinct indices"
            )
        require_at_least("plan.gmis_per_gpu", self.gmis_per_gpu, 1)
        if self.sm_percent is not None:
            require_between("plan.sm_percent", self.sm_percent, 1.0, 100.0)
        if self.memory_fraction is not None:
            require_between("plan.memory_fraction", self.memory_fraction, 0.01, 1.0)


@dataclass(frozen=True, kw_only=True)
class ReduceConfig:
    """How gradients are averaged over GMIs."""

    strategy: Literal["auto", "mpr", "mrr", "har", "flat"] = doc(
        "reduction strategy; auto: by the layout (Algorithm 1 of the paper)"
    )
    intra: Literal["auto", "host", "ipc"] = doc("exchange inside one GPU, for har; auto: host")
    timeout_s: float = doc("longest wait for another GMI in one exchange, seconds")

    def __post_init__(self) -> None:
        require_positive("reduce.timeout_s", self.timeout_s)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The run folder and the job's life."""

    dir: str | None = doc("run folder; null: runs/<env>-<algo>-<date>-<time>")
    name: str | None = doc("name of the run folder below runs/ (ignored if run.dir is given)")
    resume: str | None = doc(
        "continue from a run folder, from one of its checkpoints, or from `last`"
    )
    checkpoint_every: int = doc("iterations between checkpoints; 0: only at the end")
    measure_throughput: bool = doc(
        "after training, also measure simulation alone and simulation with inference"
    )
    start_timeout_s: float = doc("longest wait for a GMI to start and compile, seconds")
    stall_timeout_s: float = doc("a GMI with no progress for this long has failed, seconds")
    grace_s: float = doc("time a GMI gets to end by itself before it is killed, seconds")

    def __post_init__(self) -> None:
        require_at_least("run.checkpoint_every", self.checkpoint_every, 0)
        for key in ("start_timeout_s", "stall_timeout_s", "grace_s"):
            require_positive(f"run.{key}", getattr(self, key))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that `python -m gmijax.train` can be told."""

    env: EnvConfig
    algo: PpoConfig
    physics: PhysicsConfig
    plan: PlanConfig
    reduce: ReduceConfig
    run: RunConfig
    num_envs: int = doc("N, environments per GMI")
    num_timesteps: int = doc("environment steps of the whole job, all GMIs together")
    seed: int = doc("seed of every random number in the job")

    def __post_init__(self) -> None:
        require_at_least("num_envs", self.num_envs, 1)
        require_at_least("num_timesteps", self.num_timesteps, 1)
        require_between("seed", self.seed, 0, 2**31 - 1)
        samples = self.num_envs * self.algo.unroll_length
        if samples % self.algo.num_minibatches:
            raise ConfigError(
                f"num_envs={self.num_envs}: num_envs x algo.unroll_length = {samples} samples "
                f"do not divide into algo.num_minibatches={self.algo.num_minibatches} minibatches"
            )


@dataclass(frozen=True, kw_only=True)
class PlayRunConfig:
    """The run to play."""

    dir: str | None = doc("run folder, or `last`; null: the run of `checkpoint`, else `last`")


@dataclass(frozen=True, kw_only=True)
class PlayConfig:
    """Everything that `python -m gmijax.play` can be told."""

    run: PlayRunConfig
    physics: PhysicsConfig
    checkpoint: str | None = doc("folder of a checkpoint, or its env steps; null: the latest")
    num_envs: int = doc("N, environments, one episode each")
    seed: int = doc("seed of the episodes' starts and of sampled actions")
    deterministic: bool = doc("act with the policy's mean; false: sample actions")
    randomize: Literal["off", "on"] = doc(
        "play in worlds drawn from the run's env.randomization; off: in the model as it is",
        default="off",
    )
    max_steps: int | None = doc("cut episodes off after this many steps; null: only the task does")
    video: Literal["auto", "mp4", "gif", "both", "none"] = doc(
        "what to film; auto: mp4, or nothing where there is no headless OpenGL"
    )
    video_envs: int = doc("how many of the environments are shown, in a grid")
    html: Literal["auto", "on", "off"] = doc(
        "write a page with the first environment in 3D, with Brax's viewer, which a browser loads "
        "from the internet; auto: where brax is installed and knows the model's shapes"
    )
    width: int = doc("width of the picture in pixels")
    height: int = doc("height of the picture in pixels")
    camera: str | None = doc("name of a camera of the model; null: one that tracks the robot")

    def __post_init__(self) -> None:
        require_at_least("num_envs", self.num_envs, 1)
        require_between("seed", self.seed, 0, 2**31 - 1)
        require_between("video_envs", self.video_envs, 1, self.num_envs)
        if self.max_steps is not None:
            require_at_least("max_steps", self.max_steps, 1)
        for key in ("width", "height"):
            require_between(key, getattr(self, key), 64, 4096)
