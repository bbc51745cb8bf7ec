"""AT-14b, short: logs cut and logs with wrong bits give a result or a clear refusal. `make soak` takes many more."""

from __future__ import annotations

import random
import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from damaged_logs import COMMANDS, KINDS, cut, flipped, flown, judged, read

from magmav.cli import main


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return flown(tmp_path_factory.mktemp("whole"), 20.0)


@pytest.mark.parametrize("kind", KINDS)
def test_AT_14b_readers_give_readings_or_refuse(tmp_path: Path, whole: dict[str, bytes], kind: str) -> None:
    rng, path = random.Random(f"short {kind}"), tmp_path / f"harmed.{kind}"
    ends: Counter[str] = Counter()
    for one in range(33):
        path.write_bytes((cut if one % 11 == 0 else flipped)(whole[kind], rng))
        ends[read(path)] += 1
    path.write_bytes(b"")
    ends[read(path)] += 1
    assert set(ends) <= {"read", "refused"}, ends
    assert ends["read"] > 15 and ends["refused"] >= 1


@pytest.mark.parametrize("kind", KINDS)
def test_AT_14b_the_whole_command_ends_in_a_result_or_a_refusal(
    tmp_path: Path, whole: dict[str, bytes], kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, path = random.Random(f"command {kind}"), tmp_path / f"harmed.{kind}"
    ends: Counter[str] = Counter()
    for command in COMMANDS:
        for harm in (cut, flipped):
            path.write_bytes(harm(whole[kind], rng))
            where = ["--out", str(tmp_path / "out")] if command == "fit" else []
            code = main([command, str(path), "--json", *where])
            said = capsys.readouterr()
            ends[judged(code, said.out, said.err)] += 1
    assert set(ends) <= {"result", "refused"}, ends


def test_a_broken_word_would_be_seen() -> None:
    assert judged(1, "", "Traceback (most recent call last)").startswith("BROKEN")
    assert judged(2, "", "some ValueError").startswith("BROKEN"), "the words were right: it came from within"
    assert judged(3, "", "").startswith("BROKEN") and judged(-9, "{}", "").startswith("BROKEN")
    assert judged(0, "{}", "") == "result" and judged(3, "", "x.bin: is empty") == "refused"
