"""The card beside the shipped weights speaks of these weights, and its commands can be typed."""

import hashlib
import re
import shlex

import pytest
import typer

from sl3d_slam.cli.train import train
from sl3d_slam.learning.towns import HELD_OUT, TOWNS
from sl3d_slam.lines.extract import SHIPPED_WEIGHTS, LineExtractor

CARD = (SHIPPED_WEIGHTS.parent / "MODEL_CARD.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    sl3d (.+)$", CARD, re.MULTILINE)


def test_the_card_names_the_weights_that_ship():
    content = SHIPPED_WEIGHTS.read_bytes()
    assert hashlib.sha256(content).hexdigest() in CARD
    assert LineExtractor.pretrained().model in CARD
    assert len(content) < 2_000_000


@pytest.mark.parametrize("line", COMMANDS)
def test_every_option_of_its_commands_exists(line):
    verb, name, *words = shlex.split(line)
    assert verb == "train"
    command = typer.main.get_command(train).commands[name]
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= known


def test_its_commands_learn_from_all_towns_and_not_from_those_held_out():
    assert len(COMMANDS) == 4
    last = next(line for line in COMMANDS if "train joint" in line)
    named = set()
    for first, end in re.findall(r"\$T/\{(\d+)\.\.(\d+)\}", last):
        named |= set(range(int(first), int(end) + 1))
    named |= {int(number) for number in re.findall(r"\$T/(\d+)", last)}
    assert named == {plan.seed for plan in TOWNS}
    assert HELD_OUT.seed not in named
    assert not any(drive in line for line in COMMANDS for drive in ("$R/05", "$R/32"))
