"""The report in a real browser: fits a phone and a desk, prints, asks for nothing."""

from __future__ import annotations

import json
import subprocess

import pytest
from report_entry import entry
from rig import CLIENTS, peer

from magmav.view.report import write_report

pytestmark = pytest.mark.peers
_ENOUGH_S = 120.0


@pytest.mark.long
def test_the_report_fits_a_phone_and_paper_and_asks_for_nothing(tmp_path):
    python = peer("page-playwright")
    page, pdf = tmp_path / "report.html", tmp_path / "report.pdf"
    write_report(entry(), page)
    run = subprocess.run(
        [python, CLIENTS / "page_look.py", page, pdf], capture_output=True, text=True, timeout=_ENOUGH_S
    )
    if run.stderr.startswith("no browser"):
        pytest.skip(run.stderr.strip())
    assert run.returncode == 0, run.stderr
    seen = json.loads(run.stdout)
    assert seen["asked"] == [page.as_uri()] * 2  # the page itself, and nothing else
    assert seen["said"] == []  # its own policy is not broken by it
    for width in (390, 1200):
        there = seen[str(width)]
        assert there["width"] == width, "the page scrolls sideways"
        assert len(there["pictures"]) == 10 and min(there["pictures"]) > 300
        assert there["smallest"] >= 9.0, "text in a picture is too small to read, CSS pixels"
    assert pdf.read_bytes().startswith(b"%PDF")
