"""Algorithm 1, which strategies a layout allows, and the cost model: pure rules."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmijax.collectives.strategies import COSTS, predicted_s
from gmijax.errors import ConfigError
from gmijax.partition import reduction
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import (
    leaders,
    needs_ring,
    require_strategy,
    select_strategy,
    why_not_intra,
    why_not_strategy,
)

SPREAD = ((0, 2), (1, 3))

LAYOUTS = st.lists(st.integers(1, 5), min_size=1, max_size=6).map(
    lambda sizes: Layout(
        tuple(tuple(range(sum(sizes[:gpu]), sum(sizes[: gpu + 1]))) for gpu in range(len(sizes)))
    )
)


@pytest.mark.parametrize(
    ("gmis_of_gpu", "strategy", "why"),
    [
        (((0,),), "mpr", "one GPU"),
        (((0, 1, 2, 3, 4),), "mpr", "one GPU"),
        (((0,), (1,)), "mrr", "1 GMIs on each of 2 GPUs"),
        (((0, 1), (2, 3)), "mrr", "2 GMIs on each of 2 GPUs"),
        (((0, 1, 2), (3, 4, 5), (6, 7, 8)), "mrr", "3 GMIs on each of 3 GPUs"),
        (((0, 1, 2), (3, 4, 5)), "har", "3 GMIs on each of only 2 GPUs"),
        (((0, 1), (2,)), "har", "different numbers of GMIs"),
        (((0,), (1,), (2, 3)), "har", "different numbers of GMIs"),
    ],
)
def test_algorithm_1_by_the_table(
    gmis_of_gpu: tuple[tuple[int, ...], ...], strategy: str, why: str
) -> None:
    choice = select_strategy(Layout(gmis_of_gpu))
    assert choice.strategy == strategy
    assert why in choice.why


def printed_algorithm_1(mapping: list[list[int]]) -> str:
    """The paper's listing, word for word."""
    gmi_per_gpu_set = set()
    if len(mapping) <= 1:
        return "mpr"
    for gmi_li in mapping:
        gmi_per_gpu_set.add(len(gmi_li))
    if len(gmi_per_gpu_set) > 1:
        return "har"
    if gmi_per_gpu_set.pop() > len(mapping):
        return "har"
    return "mrr"


@given(LAYOUTS)
def test_algorithm_1_is_the_listing_and_its_answer_can_run(layout: Layout) -> None:
    strategy = select_strategy(layout).strategy
    assert strategy == printed_algorithm_1([list(gmis) for gmis in layout.gmis_of_gpu])
    assert why_not_strategy(strategy, layout) is None


@pytest.mark.parametrize(
    ("strategy", "gmis_of_gpu", "message"),
    [
        ("mrr", ((0, 1), (2,)), r"mrr: cannot run on layout \[\[0,1\],\[2\]\]: .* \[2, 1\] GMIs"),
        ("mrr", ((0, 1),), r"on layout \[\[0,1\]\]: its rings go from GPU to GPU"),
        ("mrr", ((0, 1, 2), (3, 4, 5)), "each of the 3 first rings.* there are only 2"),
        ("flat", ((0, 1), (2, 3)), r"flat: cannot run on layout .*NCCL before 2\.30"),
        ("flat", ((0,),), "there is only one"),
        ("none", ((0, 1),), "only for a job with one GMI, this one has 2"),
        ("telepathy", ((0,),), "expected one of none, mpr, mrr, har, flat"),
    ],
)
def test_what_cannot_run_names_strategy_layout_and_reason(
    strategy: str, gmis_of_gpu: tuple[tuple[int, ...], ...], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        require_strategy(strategy, Layout(gmis_of_gpu))


@pytest.mark.parametrize(
    ("strategy", "backend", "reason"),
    [
        ("one_shot", "cpu", "CUDA IPC needs an NVIDIA GPU"),
        ("one_shot", "mig", "there is no CUDA IPC between the instances"),
        ("mrr", "mig", "rings between MIG instances are not supported"),
    ],
)
def test_what_a_backend_lacks_names_strategy_layout_and_reason(
    strategy: str, backend: str, reason: str
) -> None:
    layout = Layout.even(2, 2)
    require_strategy(strategy, layout)
    expected = rf"{strategy}: cannot run on layout \[\[0,1\],\[2,3\]\]: {reason}"
    with pytest.raises(ConfigError, match=expected):
        require_strategy(strategy, layout, backend)


@pytest.mark.parametrize(
    ("backend", "reason"),
    [("cpu", "NVIDIA GPU"), ("mig", "MIG"), ("mps", "cuda-bindings"), ("share", "cuda-bindings")],
)
def test_device_exchange_says_why_it_is_not_to_be_had(
    backend: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "is_installed", lambda *_: False)
    assert reason in (why_not_intra("ipc", backend) or "")
    assert why_not_intra("host", backend) is None
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)
    assert (why_not_intra("ipc", backend) is None) == (backend in ("mps", "share"))


@pytest.mark.parametrize(
    ("version", "is_enough"),
    [("12.8.0", False), ("12.9.0.post1", False), ("12.9.1", True), ("13.0.0", True), (None, True)],
)
def test_bindings_that_hold_up_python_are_too_old(
    version: str | None, is_enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)
    monkeypatch.setattr(reduction, "versions_of", lambda names: dict.fromkeys(names, version))
    reason = why_not_intra("ipc", "mps")
    assert (reason is None) == is_enough
    if reason is not None:
        assert f"12.9.1 or newer, and {version} is installed (pip install " in reason
        require_strategy("one_shot", Layout.even(1, 2))
        with pytest.raises(ConfigError, match="is installed"):
            require_strategy("one_shot", Layout.even(1, 2), "mps")


@pytest.mark.parametrize(
    ("gmis_of_gpu", "expected"),
    [
        (((0, 1, 2), (3, 4, 5)), (0, 3)),
        (((0,), (1,)), (0, 1)),
        (((1, 2), (0, 3)), (2, 0)),  # the paper's rule, id % 2 == 0
        (SPREAD, (0, 1)),  # the rule gives GPU 0 both, GPU 1 none
        (((0, 1), (2,)), (0, 2)),
    ],
)
def test_every_gpu_has_one_leader(
    gmis_of_gpu: tuple[tuple[int, ...], ...], expected: tuple[int, ...]
) -> None:
    assert leaders(Layout(gmis_of_gpu)) == expected


@given(LAYOUTS)
def test_leaders_live_on_their_gpus(layout: Layout) -> None:
    for leader, gmis in zip(leaders(layout), layout.gmis_of_gpu, strict=True):
        assert leader in gmis


def test_only_what_leaves_the_host_needs_a_ring() -> None:
    one, two = Layout.even(1, 2), Layout.even(2, 2)
    assert [needs_ring(name, two) for name in ("mpr", "mrr", "har", "flat", "one_shot")] == [
        *(False, True, True, True, False)
    ]
    assert not needs_ring("har", one)


def test_costs_are_those_of_table_2() -> None:
    # g = 4 GPUs, t = 3 GMIs, M_p = 12 bytes, B1 = 2 and B2 = 9 bytes a second, by hand.
    numbers = (4, 3, 12.0, 2.0, 9.0)
    by_hand = {
        "mpr": 2 * 11 * 12 / (12 * 2),
        "mrr": 2 * 3 * 4 * 12 / (4 * 9),
        "har": 2 * 3 * 12 / (4 * 9) + 2 * 2 * 12 / (3 * 2),
        "flat": 2 * 11 * 12 / (12 * 9),
        "one_shot": 3 * 3 * 12 / 9,
    }
    assert {name: cost(*numbers) for name, cost in COSTS.items()} == pytest.approx(by_hand)


def test_predictions_take_floats_and_the_fullest_gpu() -> None:
    layout = Layout(((0, 1), (2,)))
    assert predicted_s("mpr", layout, 100, 1e3, 1e3) == pytest.approx(2 * 3 * 400 / (4 * 1e3))
    with pytest.raises(ConfigError, match=r"bandwidths \[1.0, 1.0, 0.0\]: must be positive"):
        predicted_s("mpr", layout, 100, 1.0, 1.0, 0.0)
