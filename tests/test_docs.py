"""What the documentation promises is what the code says."""

from __future__ import annotations

import re
from pathlib import Path

from own_board import OwnBoard

import magmav
from magmav.cli import parser
from magmav.core.types import Reason
from magmav.settings import Knob, knobs

ROOT = Path(__file__).parents[1]


def test_every_reason_stands_in_the_verdicts_page_with_its_number_and_sentence() -> None:
    page = (ROOT / "docs" / "verdicts.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (.+?) \| .+ \|$", page, flags=re.M)
    assert rows == [(r.name, str(r.number), r.text) for r in Reason]


def test_reason_numbers_are_unique_and_no_reason_is_a_bare_failed() -> None:
    assert len({r.number for r in Reason}) == len(Reason)
    assert not [r for r in Reason if "fail" in r.text.lower() or (len(r.text.split()) < 3 and r is not Reason.ARMED)]


def test_the_readme_names_only_commands_and_options_that_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = next(a for a in parser()._actions if a.dest == "command").choices
    assert commands is not None
    shown = "\n".join(re.findall(r"```sh\n(.*?)```", text, flags=re.S))
    lines = re.findall(r"^magmav (.+)$", shown, flags=re.M)
    assert len(lines) > 8
    for line in lines:
        words = line.split("#")[0].split()
        sub = commands[words[0]]
        known = {option for action in sub._actions for option in action.option_strings}
        if words[0] != "sim":
            assert {w for w in words[1:] if w.startswith("--")} <= known, line


def test_everything_the_package_offers_by_name_is_there() -> None:
    for name in magmav.__all__:
        assert getattr(magmav, name) is not None


def allowed(k: Knob) -> tuple[str, str]:
    """What a setting may be, and its default, as the page says it."""
    if k.choices:
        return ", ".join(f"{i} {c}" for i, c in enumerate(k.choices)), str(k.choices.index(k.default))
    if k.kind == "bool":
        return "0 off, 1 on", str(int(k.default))
    return f"{k.low:g} to {k.high:g}" + (f" {k.unit}" if k.unit else ""), f"{k.default:g}"


def test_the_page_of_parameters_is_the_one_table() -> None:
    page = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(MMAG_\w+)` \| `([\w.]+)` \| (.+?) \| (.+?) \| (.+) \|$", page, flags=re.M)
    assert rows == [(k.param, f"{k.section}.{k.key}", *allowed(k), k.text) for k in knobs() if k.param]


def test_the_page_of_parameters_names_every_one_and_no_other() -> None:
    page = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(MMAG_\w+)`", page))
    served = {entry.name for entry in OwnBoard().entries}
    assert named <= served
    short = {re.sub(r"^(MMAG_(?:OFS|SD))[23]?_[XYZ]$", r"\1_X", name) for name in served}
    assert short <= named
    assert "docs/parameters.md" in (ROOT / "README.md").read_text(encoding="utf-8")
