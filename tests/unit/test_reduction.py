"""Algorithm 1, which strategies a layout allows, and the cost model: pure rules."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmijax.collectives.strategies import (
    COSTS,
    flat_s,
    har_s,
    mpr_s,
    mrr_s,
    one_shot_s,
    predicted_s,
)
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

LAYOUTS = st.lists(st.integers(1, 5), min_size=1, max_size=6).map(
    lambda sizes: Layout(
        tuple(tuple(range(sum(sizes[:gpu]), sum(sizes[: gpu + 1]))) for gpu in range(len(sizes)))
    )
)


@pytest.mark.parametrize(
    ("gmis_of_gpu", "why"),
    [
        (((0, 1, 2, 3, 4),), "one GPU"),
        (((0, 1), (2, 3)), "2 GMIs on each of 2 GPUs"),
        (((0, 1, 2), (3, 4, 5)), "3 GMIs on each of only 2 GPUs"),
        (((0,), (1,), (2, 3)), "different numbers of GMIs"),
    ],
)
def test_algorithm_1_says_why(gmis_of_gpu: tuple[tuple[int, ...], ...], why: str) -> None:
    assert why in select_strategy(Layout(gmis_of_gpu)).why


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
    ("strategy", "gmis_of_gpu", "backend", "message"),
    [
        ("mrr", ((0, 1), (2,)), None, r"mrr: cannot .* \[\[0,1\],\[2\]\]: .* \[2, 1\] GMIs"),
        ("mrr", ((0, 1),), None, r"on layout \[\[0,1\]\]: its rings go from GPU to GPU"),
        ("mrr", ((0, 1, 2), (3, 4, 5)), None, "each of the 3 first rings.* there are only 2"),
        ("flat", ((0, 1), (2, 3)), None, r"flat: cannot run on layout .*NCCL before 2\.30"),
        ("flat", ((0,),), None, "there is only one"),
        ("none", ((0, 1),), None, "only for a job with one GMI, this one has 2"),
        ("telepathy", ((0,),), None, "expected one of none, mpr, mrr, har, flat"),
        # Only the backend lacks something.
        ("one_shot", ((0,), (1,)), "cpu", r"\[1\]\]: CUDA IPC needs an NVIDIA GPU"),
        ("one_shot", ((0,), (1,)), "mig", "there is no CUDA IPC between the instances"),
        ("mrr", ((0,), (1,)), "mig", "rings between MIG instances are not supported"),
    ],
)
def test_what_cannot_run_names_strategy_layout_and_reason(
    strategy: str, gmis_of_gpu: tuple[tuple[int, ...], ...], backend: str | None, message: str
) -> None:
    if backend is not None:
        require_strategy(strategy, Layout(gmis_of_gpu))
    with pytest.raises(ConfigError, match=message):
        require_strategy(strategy, Layout(gmis_of_gpu), backend)


@pytest.mark.parametrize(
    ("backend", "reason"),
    [("cpu", "NVIDIA GPU"), ("mig", "MIG"), ("mps", "cuda-bindings"), ("share", "cuda-bindings")],
)
def test_device_exchange_says_why_it_is_not_to_be_had(
    backend: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: False)
    assert reason in (why_not_intra("ipc", backend) or "")
    assert why_not_intra("host", backend) is None
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: True)
    assert (why_not_intra("ipc", backend) is None) == (backend in ("mps", "share"))


@pytest.mark.parametrize(
    ("version", "is_enough"),
    [("12.8.0", False), ("12.9.0.post1", False), ("12.9.1", True), ("13.0.0", True), (None, True)],
)
def test_bindings_that_hold_up_python_are_too_old(
    version: str | None, is_enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: True)
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
        (((0, 2), (1, 3)), (0, 1)),  # the rule gives GPU 0 both, GPU 1 none
        (((0, 1), (2,)), (0, 2)),
    ],
)
def test_every_gpu_has_one_leader(
    gmis_of_gpu: tuple[tuple[int, ...], ...], expected: tuple[int, ...]
) -> None:
    assert leaders(Layout(gmis_of_gpu)) == expected


def test_only_what_leaves_the_host_needs_a_ring() -> None:
    one, two = Layout.even(1, 2), Layout.even(2, 2)
    assert [needs_ring(name, two) for name in ("mpr", "mrr", "har", "flat", "one_shot")] == [
        *(False, True, True, True, False)
    ]
    assert not needs_ring("har", one)


def test_costs_are_those_of_table_2() -> None:
    # g = 4 GPUs, t = 3 GMIs, M_p = 12 bytes, B1 = 2 and B2 = 9 bytes a second, by hand.
    numbers = (4, 3, 12.0, 2.0, 9.0)
    assert mpr_s(*numbers) == pytest.approx(2 * 11 * 12 / (12 * 2))
    assert mrr_s(*numbers) == pytest.approx(2 * 3 * 4 * 12 / (4 * 9))
    assert har_s(*numbers) == pytest.approx(2 * 3 * 12 / (4 * 9) + 2 * 2 * 12 / (3 * 2))
    assert flat_s(*numbers) == pytest.approx(2 * 11 * 12 / (12 * 9))
    assert one_shot_s(*numbers) == pytest.approx(3 * 3 * 12 / 9)


@given(st.integers(2, 8), st.floats(1e3, 1e9), st.floats(1e6, 1e12))
def test_with_one_gmi_a_gpu_a_hierarchy_is_one_ring(g: int, m_p: float, b: float) -> None:
    assert har_s(g, 1, m_p, b, b) == pytest.approx(flat_s(g, 1, m_p, b, b))


def test_predictions_take_floats_and_the_fullest_gpu() -> None:
    layout = Layout(((0, 1), (2,)))
    assert predicted_s("mpr", layout, 100, 1e3, 1e3) == pytest.approx(2 * 3 * 400 / (4 * 1e3))
    assert {name for name in COSTS if predicted_s(name, layout, 1, 1.0, 1.0) > 0} == set(COSTS)
    with pytest.raises(ConfigError, match="must be positive"):
        predicted_s("mpr", layout, 100, 0.0, 1.0)
    with pytest.raises(ConfigError, match="expected one of mpr, mrr, har, flat"):
        predicted_s("none", layout, 100, 1.0, 1.0)
