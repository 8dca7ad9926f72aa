"""Which GMI lives on which GPU of which node: pure data, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.errors import ConfigError


@dataclass(frozen=True)
class Layout:
    """GMI ids of every GPU, the mapping list of the paper's Algorithm 1.

    `Layout(((0, 1, 2), (3, 4, 5)))` is two GPUs with three GMIs each. Positions count GPUs of
    the job (0 is its first), not the machine's indices. Uneven layouts are allowed.

    With several nodes all of them are alike: the GPUs are split evenly and in order, and so are
    the ids.

    Attributes:
      gmis_of_gpu: ids by GPU.
      num_nodes: how many machines.

    Raises:
      ConfigError: no GPU, a GPU without a GMI, or ids that are not 0 .. K-1, each once.
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

        sizes = {len(gmis) for gmis in self.gmis_of_node}
        ids_of_nodes = [gmi for gmis in self.gmis_of_node for gmi in gmis]
        if self.num_gpus % self.num_nodes or len(sizes) > 1 or ids_of_nodes != ids:
            raise ConfigError(
                f"plan.layout={self}: {self.num_nodes} nodes must be alike, with ids in order"
            )

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
        """GMI ids of every node in order; the place of an id is its rank in the node."""
        each = self.num_gpus // self.num_nodes
        nodes = (
            self.gmis_of_gpu[node * each : (node + 1) * each] for node in range(self.num_nodes)
        )
        return tuple(tuple(sorted(gmi for gpu in gpus for gmi in gpu)) for gpus in nodes)

    def node_of(self, gmi: int) -> int:
        """Position of the node that holds `gmi`."""
        return gmi * self.num_nodes // self.num_gmis

    @property
    def of_one_node(self) -> Layout:
        """The layout that every node has by itself, with ids from 0."""
        return Layout(self.gmis_of_gpu[: self.num_gpus // self.num_nodes])
