"""The same logs on a real Dask cluster give the same answers; without one, or without Dask, it says what to do."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from many_rig import flown

from magmav.fitting import FitOptions, cluster, fit
from magmav.fitting.ledger import Ledger, work_key
from magmav.fitting.many import fit_many
from magmav.settings import Settings

KEY = work_key(Settings(), FitOptions())


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    (folder / "a.tlog").write_bytes(flown(0, seed=1))
    (folder / "b.tlog").write_bytes(flown(1, seed=2))
    (folder / "noise.bin").write_bytes(bytes(range(256)) * 8)
    return folder


def entries(folder: Path, ledger_in: Path, dask: str) -> tuple[list[Any], list[Any], Any]:
    with Ledger(ledger_in / "ledger.jsonl", KEY) as ledger:
        run = fit_many([folder], Settings(), FitOptions(), ledger, jobs=1, dask=dask)
        return list(run.entries(ledger)), run.errors, run.table(ledger)


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # of distributed and tornado, while they start and stop
def test_a_local_cluster_gives_what_one_process_gives(logs: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as real:
        got = entries(logs, tmp_path / "cluster", real.scheduler_address)
    want = [msgspec.json.decode(msgspec.json.encode(fit(logs / name), enc_hook=float)) for name in ("a.tlog", "b.tlog")]
    assert got[0] == want and got[2]["logs"] == 2
    assert [error["path"] for error in got[1]] == [str(logs / "noise.bin")]
    assert [row["path"] for row in got[2]["vehicles"][0]["compasses"][0]["logs"]] == [f"{logs}/{n}.tlog" for n in "ab"]


def test_an_address_where_nobody_answers(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.3)
    with pytest.raises(cluster.ClusterError, match=r"--dask tcp://127\.0\.0\.1:9: no Dask scheduler answers there"):
        entries(logs, tmp_path, "tcp://127.0.0.1:9")
    with pytest.raises(cluster.ClusterError, match="--dask nonsense://x: no Dask scheduler answers"):
        entries(logs, tmp_path, "nonsense://x")


def test_without_the_extra_the_command_says_how_to_get_it(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from magmav.cli import main

    monkeypatch.setitem(sys.modules, "distributed", None)
    words = ["fit", str(logs), "--out", str(tmp_path), "--dask", "tcp://127.0.0.1:9", "--json"]
    assert main(words) == 4
    said = json.loads(capsys.readouterr().out)["error"]
    assert said["code"] == 4 and "pip install 'magmav[dask]'" in said["text"]
