"""Where serving and training GMIs go."""

from __future__ import annotations

import json

import pytest
from supervision import machine
from supervision import planned as plan_of

from gmijax import compose
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import ConfigError
from gmijax.partition import reduction
from gmijax.partition.layout import Layout
from gmijax.partition.placement import place
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.partition.templates import AGENT, TRAINER, group_of, roles_of
from gmijax.supervise.job_kinds import training_plan


def planned(**changes):
    placed = place(PlanConfig(**changes))
    return make_plan(
        placed.plan, ReduceConfig(), 8, machine(0), template="decoupled", trainers=placed.trainers
    )


@pytest.mark.parametrize(
    ("changes", "layout", "trainers"),
    [
        ({}, "[[0,1]]", 1),
        ({"serving_gmis_per_gpu": 3, "training_gmis_per_gpu": 2}, "[[0,1,2,3,4]]", 2),
        ({"gpus": 2}, "[[1],[0]]", 1),
        ({"gpus": 8}, "[[2],[3],[4],[5],[6],[7],[0],[1]]", 2),
        ({"serving_gpus": 1, "training_gpus": 1, "serving_gmis_per_gpu": 2}, "[[1,2],[0]]", 1),
        ({"serving_gpus": (0, 1), "training_gpus": (1,)}, "[[1],[0,2]]", 1),
        ({"serving_gpus": (5, 3), "training_gpus": (7,)}, "[[2],[1],[0]]", 1),
    ],
)
def test_trainers_come_first_and_every_gpu_has_what_it_is_for(changes, layout, trainers) -> None:
    plan = planned(**changes)
    assert str(plan.layout) == layout
    serving = plan.layout.num_gmis - trainers
    assert plan.roles == ("trainer",) * trainers + ("simulator+agent",) * serving
    assert plan.strategy == ("none" if trainers == 1 else "mpr")


def test_indices_are_those_of_the_machine() -> None:
    assert place(PlanConfig(serving_gpus=(5, 3), training_gpus=(7,))).plan.gpus == (3, 5, 7)
    assert place(PlanConfig(gpus=(4, 6))).plan.gpus == (4, 6)
    apart = place(PlanConfig(gpus=(7, 2, 5), serving_gpus=2, training_gpus=1))
    assert (apart.plan.gpus, apart.plan.layout) == ((7, 2, 5), ((1,), (2,), (0,)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"serving_gmis_per_gpu": 0}, r"plan.serving_gmis_per_gpu=0: at least one GMI must act"),
        ({"training_gmis_per_gpu": 0}, r"plan.training_gmis_per_gpu=0: .* must train"),
        ({"serving_gpus": 0, "training_gpus": 1}, r"plan.serving_gpus=0: there must be serving"),
        ({"serving_gpus": (0,), "training_gpus": ()}, r"plan.training_gpus=\(\): there must be"),
        ({"serving_gpus": 2}, r"plan.training_gpus=null"),
        ({"serving_gpus": 1, "training_gpus": -1}, r"plan.training_gpus=-1: there must be"),
        ({"gpus": (0, 1), "serving_gpus": (2,), "training_gpus": (1,)}, r"plan.gpus=\[0, 1\]: .*"),
        ({"gmis_per_gpu": 3}, r"plan.gmis_per_gpu=3: .* plan.serving_gmis_per_gpu"),
        ({"serving_gpus": 1, "training_gpus": (1,)}, r"expected two numbers or two lists"),
        ({"serving_gpus": (0, 0), "training_gpus": (1,)}, r"distinct indices"),
        ({"gpus": (3,), "serving_gpus": 1, "training_gpus": 1}, r"plan.gpus=\[3\]: .* take 2"),
        ({"layout": ((0,), (1,))}, r"plan.layout=\[\[0\], \[1\]\]: with the decoupled template"),
    ],
)
def test_what_cannot_be_is_refused(changes, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        place(PlanConfig(**changes))


@pytest.mark.parametrize(
    ("overrides", "is_noted"),
    [
        ((), True),
        (("channel.transport=device",), False),
        (("channel.design=uni",), False),
        (("plan.serving_gpus=1", "plan.training_gpus=1"), False),
    ],
)
def test_a_plan_notes_that_experience_could_stay_on_the_gpu(
    overrides: tuple[str, ...], is_noted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)
    here, share = machine(2), ("env=ant", "algo=a3c", "plan.backend=share")
    plan = training_plan(compose(*share, *overrides), here)
    assert any("channel.transport=device keeps" in why for why in plan.reasons) == is_noted
    if "plan.serving_gpus=1" in overrides:
        config = compose(*share, *overrides, "channel.transport=device")
        with pytest.raises(ConfigError, match="agent 1 is on GPU 0 of the job, where no GMI tr"):
            training_plan(config, here)


UNEVEN = Layout(((3, 1), (0, 2, 4)))


@pytest.mark.parametrize(
    ("template", "trainers", "roles"),
    [
        ("tcg", (), ("simulator+agent",) * 5),
        ("tcg_ex", (), ("simulator+agent+trainer",) * 5),
        ("tdg", (), ("agent", "agent", "simulator", "simulator", "simulator")),
        (
            "decoupled",
            (2, 4),
            (*("simulator+agent",) * 2, "trainer", "simulator+agent", "trainer"),
        ),
    ],
)
def test_roles_by_template(template, trainers, roles):
    assert roles_of(template, UNEVEN, trainers) == roles


def test_dedicated_trainers_need_as_many_gmis_on_every_gpu():
    even = Layout(((3, 1), (0, 2)))
    assert roles_of("tdg_ex", even) == ("trainer", "trainer", *("simulator+agent",) * 2)
    message = r"^plan\.template=tdg_ex: the GPUs of layout .* have 2 and 3 GMIs; every trainer"
    with pytest.raises(ConfigError, match=message):
        roles_of("tdg_ex", UNEVEN)
    with pytest.raises(ConfigError, match="have 2, 3 and 4 GMIs"):
        roles_of("tdg_ex", Layout(((0, 1), (2, 3, 4), (5, 6, 7, 8))))


@pytest.mark.parametrize("template", ["tdg", "tdg_ex"])
def test_dedicated_templates_need_two_gmis_on_every_gpu(template):
    with pytest.raises(ConfigError, match=r"GPU 1 of layout \[\[0,1\],\[2\]\] has one GMI"):
        roles_of(template, Layout(((0, 1), (2,))))


def test_a_group_has_ranks_of_its_own_and_no_empty_gpu():
    layout = Layout(((0,), (1, 2), (4, 3)))
    roles = ("agent", "simulator", "trainer", "agent+trainer", "simulator")
    agents, trainers = group_of(layout, roles, AGENT), group_of(layout, roles, TRAINER)
    assert agents == ((0, 3), Layout(((0,), (1,))))
    assert trainers == ((2, 3), Layout(((0,), (1,))))
    assert group_of(layout, ("agent",) * 5, TRAINER) is None


def test_only_trainers_reduce_and_their_layout_decides_how():
    def planned(gpus: int, gmis_per_gpu: int, template: str, strategy: str = "auto") -> Plan:
        shape = {"gpus": gpus, "gmis_per_gpu": gmis_per_gpu, "template": template}
        return plan_of(machine(0), {"strategy": strategy}, **shape)

    assert planned(2, 2, "tdg").strategy == "none"
    assert planned(1, 3, "tdg_ex").strategy == "none"
    two = planned(2, 2, "tdg_ex")
    assert two.strategy == "mpr"
    assert two.roles == ("trainer", "simulator+agent") * 2
    assert Plan.from_dict(json.loads(json.dumps(two.to_dict()))) == two
    flat = planned(2, 2, "tdg_ex", "flat")  # One trainer on every GPU, whatever else is there.
    assert flat.strategy == "flat"
    with pytest.raises(ConfigError, match=r"strategy=flat: cannot run on layout \[\[0\]\]"):
        planned(1, 2, "tdg_ex", "flat")
