"""Roles of the GMIs of a layout."""

from __future__ import annotations

import json

import pytest
from supervision import machine, plan_config, reduce_config

from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.partition.templates import AGENT, TRAINER, group_of, roles_of

UNEVEN = Layout(((3, 1), (0, 2, 4)))


def test_colocated_templates_give_every_gmi_the_same_roles():
    assert roles_of("tcg", UNEVEN) == ("simulator+agent",) * 5
    assert roles_of("tcg_ex", UNEVEN) == ("simulator+agent+trainer",) * 5


def test_dedicated_templates_have_one_agent_or_trainer_on_every_gpu():
    assert roles_of("tdg", UNEVEN) == ("agent", "agent", "simulator", "simulator", "simulator")
    assert roles_of("tdg_ex", UNEVEN)[:3] == ("trainer", "trainer", "simulator+agent")


@pytest.mark.parametrize("template", ["tdg", "tdg_ex"])
def test_dedicated_templates_need_two_gmis_on_every_gpu(template):
    with pytest.raises(ConfigError, match=r"GPU 1 of layout \[\[0,1\],\[2\]\] has one GMI"):
        roles_of(template, Layout(((0, 1), (2,))))


def test_decoupled_trains_where_it_is_told():
    roles = roles_of("decoupled", UNEVEN, trainers=(2, 4))
    assert roles == (*("simulator+agent",) * 2, "trainer", "simulator+agent", "trainer")


@pytest.mark.parametrize(
    ("trainers", "said"),
    [((), "no GMI trains"), (range(5), "all 5 GMIs train"), ((5,), "no GMI 5 in layout")],
)
def test_decoupled_needs_both_sides(trainers, said: str):
    with pytest.raises(ConfigError, match=said):
        roles_of("decoupled", UNEVEN, trainers)


def test_a_group_has_ranks_of_its_own_and_no_empty_gpu():
    layout = Layout(((0,), (1, 2), (4, 3)))
    roles = ("agent", "simulator", "trainer", "agent+trainer", "simulator")
    agents, trainers = group_of(layout, roles, AGENT), group_of(layout, roles, TRAINER)
    assert agents == ((0, 3), Layout(((0,), (1,))))
    assert trainers == ((2, 3), Layout(((0,), (1,))))
    assert group_of(layout, ("agent",) * 5, TRAINER) is None


def test_the_plan_carries_roles_and_only_trainers_reduce():
    def planned(**changes) -> Plan:
        return make_plan(plan_config(**changes), reduce_config(), 8, machine(0))

    assert planned(gpus=2, gmis_per_gpu=2, template="tdg").strategy == "none"
    assert planned(gpus=1, gmis_per_gpu=3, template="tdg_ex").strategy == "none"
    two = planned(gpus=2, gmis_per_gpu=2, template="tdg_ex")
    assert two.strategy == "mpr"
    assert two.roles == ("trainer", "simulator+agent") * 2
    assert Plan.from_dict(json.loads(json.dumps(two.to_dict()))) == two


def test_the_layout_of_the_trainers_decides_how_they_reduce():
    def planned(strategy: str, gmis_per_gpu: int = 2) -> Plan:
        config = plan_config(gpus=2, gmis_per_gpu=gmis_per_gpu, template="tdg_ex")
        return make_plan(config, reduce_config(strategy=strategy), 8, machine(0))

    plan = planned("flat")  # One trainer on every GPU, whatever else is there.
    assert plan.strategy == "flat"
    assert plan.training_layout.gmis_of_gpu == ((0,), (1,))
    assert planned("mrr").strategy == "mrr"
    alone = plan_config(gpus=1, gmis_per_gpu=2, template="tdg_ex")
    with pytest.raises(
        ConfigError, match=r"reduce\.strategy=flat: cannot run on layout \[\[0\]\]"
    ):
        make_plan(alone, reduce_config(strategy="flat"), 8, machine(0))


def test_plans_of_older_versions_have_holistic_gmis():
    data = make_plan(plan_config(gmis_per_gpu=2), reduce_config(), 8, machine(0)).to_dict()
    del data["roles"]
    assert Plan.from_dict(data).roles == ("simulator+agent+trainer",) * 2
