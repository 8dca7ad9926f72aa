"""Which GMI lives on which GPU of which node: pure data, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.errors import ConfigError


@dataclass(frozen=True)
class Layout:
    """GMI ids of every GPU, the mapping list of the paper's Algorithm 1.

    `Layout(((0, 1, 2), (3, 4, 5)))` is two GPUs with three GMIs each. Positions count GPUs of
    the job (0 is its first), not the machine's indices. Uneven layouts are allowed.

    With several nodes the GPUs are split evenly and in order.

    Attributes:
      gmis_of_gpu: ids by GPU.
      num_nodes: how many machines.

    Raises:
      ConfigError: no GPU, a GPU without a GMI, ids that are not 0 .. K-1, each once, or GPUs that
        cannot be split.
    """

    gmis_of_gpu: tuple[tuple[int, ...], ...]
    num_nodes: int = 1

    def __post_init__(self) -> None:
        if not self.gmis_of_gpu or any(not gmis for gmis in self.gmis_of_gpu):
            raise ConfigError(f"plan.layout={self}: every GPU needs at least one GMI")
        ids = sorted(gmi for gmis in self.gmis_of_gpu for gmi in gmis)
        if ids != list(range(len(ids))):
            raise ConfigError(
                f"plan.layout={self}: GMI ids must be 0 to {len(ids) - 1}, each exactly once"
            )
        if self.num_gpus % self.num_nodes:
            raise ConfigError(
                f"plan.layout={self}: {self.num_gpus} GPUs are not as many on each of "
                f"{self.num_nodes} nodes"
            )

    @property
    def is_alike(self) -> bool:
        """Whether the GMIs of all nodes are placed alike, with ids in order."""
        return self == self.of_node(0).on_nodes(self.num_nodes)

    @classmethod
    def even(cls, num_gpus: int, gmis_per_gpu: int) -> Layout:
        """The layout with `gmis_per_gpu` consecutive ids on each of `num_gpus` GPUs."""
        return cls(
            tuple(
                tuple(range(gpu * gmis_per_gpu, (gpu + 1) * gmis_per_gpu))
                for gpu in range(num_gpus)
            )
        )

    def on_nodes(self, num_nodes: int) -> Layout:
        """The layout in which each of so many nodes has this one."""
        step = self.num_gmis
        rows = tuple(
            tuple(gmi + node * step for gmi in gmis)
            for node in range(num_nodes)
            for gmis in self.gmis_of_gpu
        )
        return Layout(rows, num_nodes)

    def __str__(self) -> str:
        """As the user writes it: `[[0,1],[2]]`."""
        return "[" + ",".join(f"[{','.join(map(str, g))}]" for g in self.gmis_of_gpu) + "]"

    @property
    def num_gpus(self) -> int:
        """Number of GPUs, g in the paper's Table 2."""
        return len(self.gmis_of_gpu)

    @property
    def num_gmis(self) -> int:
        """K, number of GMIs on all GPUs."""
        return sum(len(gmis) for gmis in self.gmis_of_gpu)

    @property
    def gmis(self) -> range:
        """All GMI ids in order."""
        return range(self.num_gmis)

    def gpu_of(self, gmi: int) -> int:
        """Position of the GPU that holds `gmi`."""
        return next(gpu for gpu, gmis in enumerate(self.gmis_of_gpu) if gmi in gmis)

    def neighbours_of(self, gmi: int) -> tuple[int, ...]:
        """All GMIs on the GPU of `gmi`, itself included."""
        return self.gmis_of_gpu[self.gpu_of(gmi)]

    @property
    def gmis_of_node(self) -> tuple[tuple[int, ...], ...]:
        """GMI ids of every node in order; the index of an id is its rank in the node."""
        each = self.num_gpus // self.num_nodes
        nodes = (
            self.gmis_of_gpu[node * each : (node + 1) * each] for node in range(self.num_nodes)
        )
        return tuple(tuple(sorted(gmi for gpu in gpus for gmi in gpu)) for gpus in nodes)

    def node_of(self, gmi: int) -> int:
        """Position of the node that holds `gmi`."""
        return self.gpu_of(gmi) * self.num_nodes // self.num_gpus

    def of_node(self, node: int) -> Layout:
        """The layout of one node, with ranks in the node instead of ids."""
        each, ids = self.num_gpus // self.num_nodes, self.gmis_of_node[node]
        gpus = self.gmis_of_gpu[node * each : (node + 1) * each]
        return Layout(tuple(tuple(ids.index(gmi) for gmi in gmis) for gmis in gpus))
