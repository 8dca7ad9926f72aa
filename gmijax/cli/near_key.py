"""The key that a misspelt or shortened one may mean, or one that other libraries call so."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Collection, Mapping
from types import MappingProxyType

from gmijax.config import ALGORITHMS

_ELSEWHERE: Mapping[str, str] = MappingProxyType(
    {
        "lr": "algo.learning_rate",
        **dict.fromkeys(("gamma", "discount"), "algo.discounting"),
        **dict.fromkeys(("lam", "lambda"), "algo.gae_lambda"),
        **dict.fromkeys(("clip", "clip_range", "clip_param"), "algo.clipping_epsilon"),
        **dict.fromkeys(("ent_coef", "entropy_coef"), "algo.entropy_cost"),
        **dict.fromkeys(("epochs", "n_epochs", "num_epochs"), "algo.num_updates_per_batch"),
        **dict.fromkeys(("n_envs", "envs"), "num_envs"),
        **dict.fromkeys(("n_steps", "num_steps"), "algo.unroll_length"),
        **dict.fromkeys(("steps", "timesteps", "total_timesteps"), "num_timesteps"),
        **dict.fromkeys(("tau", "polyak"), "algo.target_rate"),
        **dict.fromkeys(("buffer_size", "replay_size"), "algo.replay_steps"),
    }
)
"""What Stable-Baselines3, CleanRL and rsl_rl call it."""

_OF_GROUPS = 0.65
"""How alike a short name such as `ent` must be to `env`: two of three letters."""

_MOST_SHOWN = 24
"""Keys that an error lists; the help has more."""


def near_key(key: str, known: Collection[str]) -> str:
    """`: did you mean ...` for a key that none of `known` is, else what is allowed, or the help.

    The last part of a key counts more than its group: `algo.gamma` is no `algo.name`.
    """
    name = key.rpartition(".")[2]
    if (meant := _ELSEWHERE.get(name.lower().replace("-", "_"))) in known:
        return f": did you mean {meant}?"
    if others := _algorithms_with(meant or key, known):
        asked = f"did you mean {meant}," if meant else "it is"
        return f": {asked} a key of algo={', '.join(others)}{'?' if meant else ''}"
    names = {one.rpartition(".")[2] for one in known}
    if close := difflib.get_close_matches(name, sorted(names), n=1, cutoff=0.75):
        so_called = sorted(one for one in known if one.rpartition(".")[2] == close[0])
        return f": did you mean {difflib.get_close_matches(key, so_called, n=1, cutoff=0.0)[0]}?"
    groups = {one.partition(".")[0] for one in known} & {"env", "algo"} - {key}
    if name == key and (group := difflib.get_close_matches(key, groups, 1, _OF_GROUPS)):
        return f": did you mean {group[0]}?"  # It chooses a task or an algorithm.
    if near := _by_words(key, known):
        return f": did you mean {near}?"
    # Keys of one group begin alike, and would all be close.
    of_others = [one for one in known if one.rpartition(".")[0] != key.rpartition(".")[0]]
    if close := difflib.get_close_matches(key, of_others, n=1, cutoff=0.75):
        return f": did you mean {close[0]}?"
    if len(known) > _MOST_SHOWN:
        return ": see --help all"
    return f"; allowed: {', '.join(sorted(known))}"


def _algorithms_with(key: str, known: Collection[str]) -> list[str]:
    """Names of the algorithms that have such a key, of a command that takes one."""
    group, _, name = key.partition(".")
    if group != "algo" or "algo.name" not in known:
        return []
    return [one.name for one in ALGORITHMS if name in one.__dataclass_fields__]


def _by_words(key: str, known: Collection[str]) -> str | None:
    """The key that has words of this one's name: `algo.rate` is `algo.learning_rate`.

    A word counts the less, the more keys have it. Among equals the group decides, then brevity.
    """
    words = {one: _words(one) for one in known}
    count = Counter(word for own in words.values() for word in own)
    scores: Counter[str] = Counter()
    for word in _words(key):
        shortened = sorted(one for one in count if len(word) > 4 and one.startswith(word))
        for close in difflib.get_close_matches(word, count, n=1, cutoff=0.8) or shortened[:1]:
            scores.update({one: 1 / count[close] for one, own in words.items() if close in own})
    group = key.rpartition(".")[0]

    def nearness(one: str) -> tuple[float, bool, int, str]:
        return -scores[one], one.rpartition(".")[0] != group, len(words[one]), one

    return min(scores, key=nearness, default=None)


def _words(key: str) -> set[str]:
    """Of the last part of a key, without units such as `s`."""
    return {word for word in key.rpartition(".")[2].lower().split("_") if len(word) > 2}
