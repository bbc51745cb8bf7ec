"""Many logs: what is finished stays finished whatever is killed, and nothing but the logs counts for the result."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from many_rig import BAD, GOOD, folder_of_logs
from process_rig import magmav

from magmav.fitting import FitOptions
from magmav.fitting.ledger import Ledger, LedgerError, work_key
from magmav.fitting.many import Run, Told, find_logs, fit_many
from magmav.settings import Settings, with_value

pytestmark = pytest.mark.long  # whole folders; test_many_bins.py holds the table

FILES = ("fits.json", "fits.csv", "fits.html")
KEY = work_key(Settings(), FitOptions())
WALL_S = 300.0


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs in ``in``, and what one run over it left in ``out``; fits are done by two processes."""
    place = tmp_path_factory.mktemp("many")
    folder_of_logs(place / "in")
    done = magmav("fit", "in", "--out", "out", "--jobs", 2, cwd=place)
    assert done.code == 0, done.err
    (place / "err").write_text(done.err)
    (place / "screen").write_text(done.out)
    return place


def table(place: Path) -> Any:
    return json.loads((place / "fits.json").read_text())


def lines(path: Path) -> list[str]:
    """sha256 of every whole line of a ledger."""
    return [json.loads(line)["sha256"] for line in path.read_bytes().split(b"\n")[:-1]] if path.exists() else []


def children(pid: int) -> list[int]:
    """Processes of the pool that belong to this one."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += (task / "children").read_text().split()
    return [int(p) for p in found if b"spawn_main" in Path(f"/proc/{p}/cmdline").read_bytes()]


def here(place: Path, out: Path, given: list[Path], **how: Any) -> tuple[Run, Any, list[Told]]:
    """The same in this process, as the command does it."""
    told: list[Told] = []
    before = Path.cwd()
    os.chdir(place)
    try:
        with Ledger(out / "ledger.jsonl", KEY) as ledger:
            run = fit_many(given, Settings(), FitOptions(), ledger, tell=told.append, **how)
            return run, run.table(ledger), told
    finally:
        os.chdir(before)


# ------------------------------------------------------------ the result


def test_one_table_by_vehicle_and_date_with_the_flight_after_which_the_offsets_changed(undisturbed: Path) -> None:
    got = table(undisturbed / "out")
    one, two = got["vehicles"]
    assert (one["system"], two["system"], got["logs"]) == (1, 2, 4)
    (compass,) = one["compasses"]
    assert [row["path"] for row in compass["logs"]] == [
        "in/2026/deep/copy of b.tlog",
        "in/2026/deep/a.TLOG",
        "in/torn.tlog",
    ]
    assert [row["date"] for row in compass["logs"]] == [f"2026-11-{day}T10:00:00Z" for day in (22, 23, 24)]
    assert compass["device_id"] == 97539 and [row["state"] for row in compass["logs"]] == ["READY"] * 3
    (change,) = compass["changes"]
    assert change["axis"] == "y" and change["by_mg"] == pytest.approx(60.0, abs=8.0)
    assert (change["after"]["path"], change["found_in"]["path"]) == ("in/2026/deep/a.TLOG", "in/torn.tlog")
    assert two["compasses"][0]["changes"] == [] and two["compasses"][0]["device_id"] == 131874
    assert got["same_content"] == [{"path": "in/b.tlog", "as": "in/2026/deep/copy of b.tlog"}]
    assert "y changed by +" in (undisturbed / "screen").read_text()
    csv = (undisturbed / "out" / "fits.csv").read_text().splitlines()
    assert (
        len(csv) == 1 + 4
        and csv[3].endswith(",True,,y")
        and all(a.count(",") == b.count(",") for a, b in pairwise(csv))
    )
    page = (undisturbed / "out" / "fits.html").read_text()
    written = sorted(file.name for file in (undisturbed / "out" / "logs").iterdir())
    assert len(written) == 8 and all(f'href="logs/{name}"' in page for name in written if name.endswith(".html"))
    assert {name.rpartition(".")[2] for name in written} == {"html", "param"}
    assert "http" not in page.replace("http-equiv", "") and "<script" not in page and page.count("<svg") == 1


def test_AT_14b_bad_logs_among_good_ones_are_named_and_stop_nobody(undisturbed: Path) -> None:
    got = table(undisturbed / "out")
    assert [error["path"] for error in got["errors"]] == [f"in/{name}" for name in BAD]
    said = (undisturbed / "err").read_text().splitlines()
    assert sorted(said) == sorted(f"magmav: {error['text']}" for error in got["errors"])
    assert all(line.startswith(f"magmav: in/{name}: ") for line, name in zip(sorted(said), BAD, strict=True))


def test_a_folder_without_any_answer_ends_with_3_and_says_why_for_each(tmp_path: Path) -> None:
    Path(os.fsdecode(bytes(tmp_path) + b"/x\xff.bin")).write_bytes(b"\xa3\x95" * 40)
    done = magmav("fit", tmp_path, tmp_path / "gone.ulg", "--out", tmp_path / "out", "--json", "--jobs", 1)
    assert done.code == 3 and done.json["logs"] == [] and len(done.json["table"]["errors"]) == 2
    assert done.json["table"]["errors"][1]["text"].startswith(f"{tmp_path}/x\ufffd.bin: ")
    assert f"{tmp_path}/gone.ulg: no such file; check the path" in done.err and "Traceback" not in done.err


# ------------------------------------------------------------ kills


@pytest.fixture(scope="module")
def killed(undisturbed: Path) -> tuple[Path, list[list[str]]]:
    """The same run, its process killed at a random moment of every log; the ledger's lines after each life."""
    chance, ledger, seen = Random(6), undisturbed / "killed" / "ledger.jsonl", []
    for finished in range(3):
        command = [sys.executable, "-m", "magmav.cli", "fit", "in", "--out", "killed", "--jobs", "1"]
        with subprocess.Popen(command, cwd=undisturbed, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
            until = time.monotonic() + WALL_S
            while len(lines(ledger)) < finished and run.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
            time.sleep(chance.uniform(0.0, 0.4))  # a log of these takes about so long
            workers = children(run.pid)
            run.send_signal(signal.SIGKILL)
        while any(Path(f"/proc/{pid}/cmdline").exists() for pid in workers) and time.monotonic() < until:
            time.sleep(0.02)
        assert time.monotonic() < until, "its processes end with it"
        seen.append(lines(ledger))
    done = magmav("fit", "in", "--out", "killed", "--jobs", 1, "--resume", cwd=undisturbed)
    assert done.code == 0, done.err
    return undisturbed, [*seen, lines(ledger)]


def test_a_run_killed_at_random_moments_goes_on_and_ends_with_the_same_bytes(
    killed: tuple[Path, list[list[str]]],
) -> None:
    place, seen = killed
    for name in (*FILES, *(f"logs/{file.name}" for file in (place / "out" / "logs").iterdir())):
        assert (place / "killed" / name).read_bytes() == (place / "out" / name).read_bytes(), name
    assert all(later[: len(earlier)] == earlier for earlier, later in pairwise(seen)), "what was finished stays"
    assert len(seen[-1]) == len(set(seen[-1])), "nothing is done twice"
    assert set(seen[-1]) == set(lines(place / "out" / "ledger.jsonl")), "nothing is lost"
    assert 0 < len(seen[2]) < len(seen[3]), "the kills came in the middle"


def test_a_worker_that_is_killed_costs_its_log_one_more_turn_and_no_other_anything(
    undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, hit = undisturbed / "worker", []

    def shoot(told: Told) -> None:
        if told.what == "progress" and not hit:
            hit.append(told.path)
            for pid in children(os.getpid()):
                os.kill(pid, signal.SIGKILL)

    monkeypatch.chdir(undisturbed)
    with Ledger(out / "ledger.jsonl", KEY) as ledger:
        run = fit_many([Path("in/b.tlog")], Settings(), FitOptions(), ledger, jobs=1, tell=shoot)
        assert hit == ["in/b.tlog"] and run.errors == [] and [path for path, _ in run.logs] == ["in/b.tlog"]
        got = next(run.entries(ledger))
    with Ledger(undisturbed / "out" / "ledger.jsonl", KEY) as whole:
        ((_, sha256),) = run.logs
        was = whole.outcome(sha256)["entry"]
    assert got["vehicles"] == was["vehicles"] and len(lines(out / "ledger.jsonl")) == 1


def test_a_log_that_kills_its_worker_every_time_is_refused_by_name_and_tried_again_next_time(
    undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = undisturbed / "deadly"

    def shoot(told: Told) -> None:
        if told.what == "progress":
            for pid in children(os.getpid()):
                os.kill(pid, signal.SIGKILL)

    monkeypatch.chdir(undisturbed)
    with Ledger(out / "ledger.jsonl", KEY) as ledger:
        run = fit_many([Path("in/b.tlog")], Settings(), FitOptions(), ledger, jobs=1, tell=shoot)
        assert run.logs == [] and len(ledger) == 0
    (error,) = run.errors
    assert error["text"].startswith("in/b.tlog: the process working on it died 2 times (signal 9)")


# ------------------------------------------------------------ what does not count


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_the_files_changes_nothing(undisturbed: Path, tmp_path: Path, seed: int) -> None:
    (tmp_path / "ledger.jsonl").write_bytes((undisturbed / "out" / "ledger.jsonl").read_bytes())
    given = [Path("in", name) for name in (*GOOD, *BAD, "2026/deep/copy of b.tlog")] + [Path("in/2026")]
    Random(seed).shuffle(given)
    _, got, told = here(undisturbed, tmp_path, given, jobs=1)
    assert json.dumps(got) == json.dumps(table(undisturbed / "out"))
    assert "begun" not in {one.what for one in told}, "the ledger had all of it"


def test_a_shuffled_ledger_gives_the_same_table(undisturbed: Path, tmp_path: Path) -> None:
    kept = (undisturbed / "out" / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    Random(3).shuffle(kept)
    (tmp_path / "ledger.jsonl").write_bytes(b"".join(kept))
    _, got, _ = here(undisturbed, tmp_path, [Path("in")])
    assert json.dumps(got) == json.dumps(table(undisturbed / "out"))


def test_a_log_that_moved_is_not_done_again_and_has_its_new_name(undisturbed: Path, tmp_path: Path) -> None:
    (tmp_path / "ledger.jsonl").write_bytes((undisturbed / "out" / "ledger.jsonl").read_bytes())
    for old, new in (("torn.tlog", "moved.tlog"), ("noise.bin", "other.bin")):
        (tmp_path / new).write_bytes((undisturbed / "in" / old).read_bytes())
    run, got, told = here(undisturbed, tmp_path, [tmp_path])
    assert [path for path, _ in run.logs] == [f"{tmp_path}/moved.tlog"] and {t.again for t in told[1:]} == {True}
    assert got["vehicles"][0]["compasses"][0]["logs"][0]["path"] == f"{tmp_path}/moved.tlog"
    assert [e["text"].partition(":")[0] for e in run.errors] == [f"{tmp_path}/other.bin"]


def test_folders_are_searched_in_one_order_and_each_file_counts_once(undisturbed: Path, tmp_path: Path) -> None:
    def wrong(path: str, text: str) -> None:
        raise AssertionError(text)

    inside = undisturbed / "in"
    found = find_logs([inside, inside / "b.tlog", inside / "2026"], wrong)
    names = sorted((*GOOD, *BAD, "2026/deep/copy of b.tlog"))
    assert [str(p.relative_to(inside)) for p in found] == names
    (tmp_path / "link").symlink_to(inside, target_is_directory=True)
    (tmp_path / "one.tlog").symlink_to(inside / "b.tlog")
    assert find_logs([tmp_path], wrong) == [tmp_path / "one.tlog"]


# ------------------------------------------------------------ the ledger

SHAS = [f"{i:064x}" for i in range(4)]
OUTCOMES: list[dict[str, Any]] = [{"entry": {"n": i, "text": "ä" * i, "x": 0.1 * i}} for i in range(4)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "ledger.jsonl"
    with Ledger(path, "w") as ledger:
        for sha256, outcome in zip(SHAS, OUTCOMES, strict=True):
            ledger.add(sha256, 7, outcome)
            ledger.add(sha256, 7, {"entry": "never twice"})
    return path.read_bytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield tmp_path_factory.mktemp("scratch") / "ledger.jsonl"


@settings(max_examples=60, deadline=None)
@given(cut=st.integers(0, 800), tail=st.binary(max_size=20))
def test_a_ledger_cut_anywhere_keeps_every_whole_line_and_grows_whole_again(
    whole: bytes, scratch: Path, cut: int, tail: bytes
) -> None:
    """tail : what a power cut may leave of the last block; without a line's end it is none."""
    kept = whole[:cut]
    scratch.write_bytes(kept + tail.replace(b"\n", b""))
    complete = kept.count(b"\n")
    with Ledger(scratch, "w") as ledger:
        assert [sha256 in ledger for sha256 in SHAS] == [i < complete for i in range(4)]
        assert [ledger.outcome(s) for s in SHAS[:complete]] == OUTCOMES[:complete]
        for sha256, outcome in zip(SHAS, OUTCOMES, strict=True):
            ledger.add(sha256, 7, outcome)
    assert scratch.read_bytes() == whole


def test_a_spoilt_line_is_counted_and_only_its_log_is_done_again(whole: bytes, tmp_path: Path) -> None:
    parts = whole.splitlines(keepends=True)
    parts[1] = b"\0" * 30 + b"\n"
    (path := tmp_path / "ledger.jsonl").write_bytes(b"".join(parts))
    with Ledger(path, "w") as ledger:
        assert ledger.damaged == 1 and [sha256 in ledger for sha256 in SHAS] == [True, False, True, True]
        assert ledger.outcome(SHAS[2]) == OUTCOMES[2]


def test_other_settings_options_or_truth_never_reuse_an_answer(tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text("a")
    of_file = FitOptions(heading_reference=str(truth))
    keys = [KEY, work_key(Settings(), FitOptions(motor=True)), work_key(Settings(), of_file)]
    keys.append(work_key(with_value(Settings(), "learn", "settle_s", 3.0), FitOptions()))
    truth.write_text("b")
    keys.append(work_key(Settings(), of_file))
    assert len(set(keys)) == 5 and work_key(Settings(), FitOptions()) == KEY
    with Ledger(tmp_path / "l", keys[0]) as ledger:
        ledger.add(SHAS[0], 7, OUTCOMES[1])
    with Ledger(tmp_path / "l", keys[1]) as other:
        assert SHAS[0] not in other and other.damaged == 0
        other.add(SHAS[0], 7, OUTCOMES[2])
    with Ledger(tmp_path / "l", keys[0]) as ledger:
        assert ledger.outcome(SHAS[0]) == OUTCOMES[1]


def test_one_run_at_a_time_on_one_ledger(tmp_path: Path) -> None:
    match = "another run is working on it; wait for it, stop it, or choose another --out"
    with Ledger(tmp_path / "l", "w"), pytest.raises(LedgerError, match=match):
        Ledger(tmp_path / "l", "w").__enter__()
    with Ledger(tmp_path / "l", "w"):
        pass


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (("--resume",), 1, "no ledger to go on from; give the --out of the run that was cut short"),
        (("--jobs", "0"), 2, "--jobs: want 1 or more, got 0"),
        (("--params", "p.param"), 2, "--params, --report: one file is for one log"),
        (("--reference", "gone.csv"), 3, "gone.csv"),
    ],
)
def test_what_cannot_be_asked_of_a_folder_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], code: int, text: str
) -> None:
    from magmav.cli import main

    out = tmp_path / "out"
    assert main(["fit", str(tmp_path), "--out", str(out), *words]) == code
    assert text in capsys.readouterr().err and not out.exists()
