"""A job whose GPUs were lost goes on with those that are left."""

from __future__ import annotations

import pytest
from supervision import gpu, machine

from gmijax.cli import compose
from gmijax.control.restarts import with_gpus_left
from gmijax.errors import ConfigError
from gmijax.supervise.kinds import training_plan

FOUR = machine(4)
LEFT = machine(0, gpus=(gpu(0), gpu(2), gpu(3)), driver_version="580.159.03")


def test_a_job_that_has_its_gpus_stays_as_it_is():
    config = compose("env=ant", "plan.gpus=2", "plan.backend=share")
    plan = training_plan(config, FOUR)
    assert with_gpus_left(config, plan, FOUR) == (config, plan, ())


def test_a_lost_gpu_shrinks_the_plan():
    config = compose(
        *("env=ant", "plan.gpus=4", "plan.gmis_per_gpu=2", "plan.backend=share", "num_envs=64"),
        *("run.elastic=true", "reduce.intra=host"),
    )
    plan = training_plan(config, FOUR)
    config, shrunk, notes = with_gpus_left(config, plan, LEFT)
    assert [share.device for share in shrunk.slices] == [
        gpu(index).uuid for index in (0, 0, 2, 2, 3, 3)
    ]
    assert (shrunk.num_envs_per_gmi, shrunk.strategy) == (64, "mrr")
    assert notes[0].startswith("GPUs [1] of the job are gone: going on with 3")


def test_algorithm_1_decides_again_for_what_is_left():
    config = compose(
        *("env=ant", "plan.gpus=2", "plan.gmis_per_gpu=2", "plan.backend=share"),
        *("run.elastic=true", "reduce.intra=host"),
    )
    plan = training_plan(config, FOUR)
    _, shrunk, _ = with_gpus_left(config, plan, LEFT)
    assert (plan.strategy, shrunk.strategy) == ("mrr", "mpr")


def test_an_uneven_layout_loses_its_row():
    config = compose(
        *("env=ant", "plan.layout=[[0],[1,2],[3,4,5]]", "plan.backend=share", "run.elastic=true")
    )
    plan = training_plan(config, FOUR)
    _, shrunk, _ = with_gpus_left(config, plan, LEFT)
    assert str(shrunk.layout) == "[[0],[1,2,3]]"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["run.elastic=false"], r"GPUs \[1\] of the job are gone; run\.elastic=true would go on"),
        (["run.elastic=true", "plan.gpus=[1]"], "gone, and no other one is left"),
    ],
)
def test_what_cannot_go_on_is_told(overrides: list[str], message: str):
    config = compose("env=ant", "plan.gpus=2", "plan.backend=share", *overrides)
    plan = training_plan(config, FOUR)
    lost = [0] if "plan.gpus=[1]" in overrides else [1]
    assert lost
    with pytest.raises(ConfigError, match=message.replace(r"\[1\]", rf"\[{lost[0]}\]")):
        with_gpus_left(config, plan, LEFT)
