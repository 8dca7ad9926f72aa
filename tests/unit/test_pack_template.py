"""Placeholders of a pack's command: what is filled, what stays, what is refused."""

from __future__ import annotations

import pytest

from gmijax.errors import ConfigError
from gmijax.packs.template import fill, placeholders, require_names


@pytest.mark.parametrize(
    ("argument", "filled"),
    [
        ("--seed={seed}", "--seed=3"),
        ("{seed}{job}", "3007"),
        ("{agent.lr}", "1e-4"),
        ("{{seed}}", "{seed}"),
        ('{{"seed": {seed}}}', '{"seed": 3}'),
        ('{"a": 1}', '{"a": 1}'),
        ("${HOME}", "${HOME}"),
        ("{}", "{}"),
        ("{0..3}", "{0..3}"),
        ("two words and 'quotes'", "two words and 'quotes'"),
    ],
)
def test_what_is_no_placeholder_passes_unharmed(argument: str, filled: str):
    values = {"seed": "3", "job": "007", "agent.lr": "1e-4"}
    assert fill([argument], values) == [filled]


def test_placeholders_are_named_once_in_order():
    assert placeholders(["{b}", "{a}{b}", "{{c}}"]) == ["b", "a"]


@pytest.mark.parametrize(
    ("arguments", "names", "message"),
    [
        (["{sed}"], {"seed": "0,1"}, r"^seed=0,1: the command has no \{seed\}"),
        (["{sed}{job}"], {"seed": "0"}, r"no \{seed\} \(it has \{sed\}, \{job\}\), so all"),
        (["true"], {"seed": "0"}, r"no \{seed\}, so all"),
        (
            ["{seed}", "{sead}"],
            {"seed": "0"},
            r"\{sead\}: no such placeholder: did you mean seed\?",
        ),
        (["{nothing}"], {}, r"\{nothing\}: no such placeholder; allowed: job, run_dir"),
        (["{job}"], {"job": "5"}, r"^job=5: every job has \{job\} of its own"),
    ],
)
def test_names_and_placeholders_must_fit(
    arguments: list[str], names: dict[str, str], message: str
):
    with pytest.raises(ConfigError, match=message):
        require_names(arguments, names)


def test_own_names_need_not_be_used():
    require_names(["train.py", "--seed", "{seed}"], {"seed": "0"})


@pytest.mark.parametrize(
    ("text", "filled"),
    [
        ('{"a": {"b": 1}}', '{"a": {"b": 1}}'),
        ('{{"seed": {seed}}}', '{"seed": 7}'),
        ("{{seed}}", "{seed}"),
        ("{}}", "{}}"),
    ],
)
def test_braces_of_json_stay(text: str, filled: str) -> None:
    assert fill([text], {"seed": "7"}) == [filled]
