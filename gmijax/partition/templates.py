"""Templates: which roles the GMIs of a layout get (paper, sec. 5.1). Pure data.

A GMI has one role or several in one process, written with `+` between them: `simulator`, `agent`
(infers actions with the policy), `trainer`.

| template | for | GMIs |
|---|---|---|
| `tcg` | serving | `simulator+agent`, all |
| `tdg` | serving | on every GPU one `agent`, the others `simulator` |
| `tcg_ex` | synchronous training | `simulator+agent+trainer`, all |
| `tdg_ex` | synchronous training | on every GPU one `trainer`, the others `simulator+agent` |
| `decoupled` | asynchronous training | some `trainer`, the others `simulator+agent` |
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.config import TemplateName
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout

SIMULATOR: Final = "simulator"
AGENT: Final = "agent"
TRAINER: Final = "trainer"

SERVING: Final = f"{SIMULATOR}+{AGENT}"
HOLISTIC: Final = f"{SIMULATOR}+{AGENT}+{TRAINER}"

DESCRIPTIONS: Mapping[TemplateName, str] = MappingProxyType(
    {
        "tcg": "every GMI simulates and infers",
        "tdg": "one GMI of every GPU infers, the others simulate",
        "tcg_ex": "every GMI simulates, infers and trains",
        "tdg_ex": "one GMI of every GPU trains, the others simulate and infer",
        "decoupled": "some GMIs train, the others simulate and infer",
    }
)
"""What the GMIs do, in words, by template."""


class Group(NamedTuple):
    """The GMIs of a layout that have a role, as ranks of their own."""

    gmis: tuple[int, ...]  # Their ids in order; a GMI's rank in the group is its position here.
    # Where they are, with ranks instead of ids; GPUs and nodes without one of them are left out.
    # Its nodes are right only if all have the same layout, which a reduction requires.
    layout: Layout


def roles_of(
    template: TemplateName, layout: Layout, trainers: Collection[int] = ()
) -> tuple[str, ...]:
    """The roles of every GMI, in order of id; in `decoupled` the `trainers` train.

    Raises:
      ConfigError: a template that this layout is too small or too uneven for.
    """
    if template == "tcg":
        return (SERVING,) * layout.num_gmis
    if template == "tcg_ex":
        return (HOLISTIC,) * layout.num_gmis
    if template == "decoupled":
        return tuple(TRAINER if gmi in trainers else SERVING for gmi in layout.gmis)
    if small := [gpu for gpu, gmis in enumerate(layout.gmis_of_gpu) if len(gmis) < 2]:
        raise ConfigError(
            f"plan.template={template}: GPU {small[0]} of layout {layout} has one GMI; "
            f"{DESCRIPTIONS[template]}, so every GPU needs at least 2 GMIs (plan.gmis_per_gpu=2)"
        )
    if template == "tdg_ex" and len(counts := {len(gmis) for gmis in layout.gmis_of_gpu}) > 1:
        raise ConfigError(
            f"plan.template={template}: the GPUs of layout {layout} have {_listed(counts)} GMIs; "
            "every trainer learns from the GMIs of its GPU, and all trainers from as many steps, "
            "so every GPU needs as many GMIs"
        )
    firsts = {min(gmis) for gmis in layout.gmis_of_gpu}
    first, others = (AGENT, SIMULATOR) if template == "tdg" else (TRAINER, SERVING)
    return tuple(first if gmi in firsts else others for gmi in layout.gmis)


def _listed(counts: Iterable[int]) -> str:
    *others, last = map(str, sorted(counts))
    return f"{', '.join(others)} and {last}"


def has_role(roles: str, role: str) -> bool:
    """Whether `role` is among `roles`, as they stand in a plan."""
    return role in roles.split("+")


def group_of(layout: Layout, roles: Iterable[str], role: str) -> Group | None:
    """The GMIs whose roles include `role`, None if no GMI has it."""
    gmis = tuple(gmi for gmi, theirs in enumerate(roles) if has_role(theirs, role))
    if not gmis:
        return None
    ranks = (
        tuple(rank for rank, gmi in enumerate(gmis) if gmi in here) for here in layout.gmis_of_gpu
    )
    gpus = tuple(here for here in ranks if here)
    num_nodes = len(nodes_of(layout, gmis))
    return Group(gmis, Layout(gpus, 1 if len(gpus) % num_nodes else num_nodes))


def nodes_of(layout: Layout, gmis: Iterable[int]) -> tuple[int, ...]:
    """Positions of the nodes that have some of these GMIs, in order."""
    return tuple(sorted({layout.node_of(gmi) for gmi in gmis}))
