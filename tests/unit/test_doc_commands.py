"""Every `gmijax` command in a document, and in the reference, is one that its parser takes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from docs.pages import documents
from docs.reference import COMMANDS, EXAMPLES, TOPICS, command_page
from gmijax.__main__ import VERBS, main

BLOCK = re.compile(r"^( *)```(?:bash)?\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
FENCE = re.compile(r"```.*?```", re.DOTALL)
INLINE = re.compile(r"`(gmijax [^`]+)`")


def commands_of(text: str) -> list[str]:
    """Lines of code blocks, and what stands in backticks, but for forms such as `gmijax pack`."""
    blocks = "\n".join(block for _, block in BLOCK.findall(text)).replace("\\\n", " ")
    lines = [*map(str.strip, blocks.splitlines()), *INLINE.findall(FENCE.sub("", text))]
    return [
        line
        for line in dict.fromkeys(lines)
        if line.startswith("gmijax ") and len(line.split()) > 2 and "..." not in line
    ]


def words_of(command: str) -> list[str]:
    """What a shell would pass to `main`, with `--cfg job`: then nothing is run."""
    words = [word for word in shlex.split(command, comments=True)[1:] if word != "&"]
    if words[0] == "serve":  # It opens the run that it names: here there is none.
        words = [re.sub(r"^run\.dir=.*", "policy=random", word) for word in words]
    if "--help" in words or "--cfg" in words:
        return words
    at = words.index("--") if "--" in words else len(words)
    return [*words[:at], "--cfg", "job", *words[at:]]


def refused(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What is printed if the command is refused; nothing if it is taken."""
    verb = command.split()[1]
    if verb not in COMMANDS:
        return "" if verb in VERBS else f"{command}: no such verb"
    code = main(words_of(command))
    error = capsys.readouterr().err
    return f"{command}: {error}" if code else ""


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_commands_of_a_document_are_taken(
    document: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "commands.txt").write_text("echo 1\n")  # Which a document names.
    found = [refused(one, capsys) for one in commands_of(document.read_text())]
    assert [line for line in found if line] == []


def test_examples_of_the_reference_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    examples = "\n".join((*EXAMPLES.values(), *(topic.example for topic in TOPICS.values())))
    commands = commands_of(f"```\n{examples}\n```\n")
    assert len(commands) >= len(EXAMPLES)
    assert [line for one in commands if (line := refused(one, capsys))] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_page(command: str):
    assert command_page(command).startswith(f"# gmijax {command}\n")


def test_a_wrong_key_is_found(capsys: pytest.CaptureFixture[str]):
    text = "```\ngmijax train env=ant algo.lerning_rate=1e-4  # no\n```\nand `gmijax pack ...`\n"
    (command,) = commands_of(text)
    assert "lerning_rate" in refused(command, capsys)
    assert refused("gmijax fly now", capsys) == "gmijax fly now: no such verb"
