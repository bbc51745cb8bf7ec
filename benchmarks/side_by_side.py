"""Every estimator on four real recordings and two simulated flights, as `magmav compare` prints it.

    python benchmarks/side_by_side.py             print the tables
    python benchmarks/side_by_side.py --write     put them into docs/methods.md, between their markers

Recordings are looked for in MAGMAV_DATA (default ../shared/data); what is missing is left as it stands.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("MAGMAV_DATA", ROOT.parent / "shared" / "data"))
PAGE = ROOT / "docs" / "methods.md"
FLIGHTS: dict[str, tuple[str, ...]] = {
    "thor75.tlog": ("flights/thor75.tlog",),
    "log171.bin": ("logs/log171.bin",),
    "esc_status_log.ulg": ("logs/esc_status_log.ulg",),
    "broad32_imu.tlog": ("flights/broad32_imu.tlog", "--reference", "flights/broad32_truth.csv"),
    "figure8": ("figure8",),
    "hover_yaw": ("hover_yaw",),
}


def printed(words: tuple[str, ...]) -> tuple[str, str] | None:
    """The command as one would type it, and what it prints; None where its recording is not here."""
    files = [w for w in words if "/" in w]
    if any(not (DATA / f).is_file() for f in files):
        return None
    command = [sys.executable, "-m", "magmav.cli", "compare", *words]
    done = subprocess.run(command, cwd=DATA if files else ROOT, capture_output=True, text=True, check=True)
    typed = " ".join(("magmav compare", *(Path(w).name for w in words)))
    return typed, "\n".join(line.rstrip() for line in done.stdout.strip().splitlines())


def replaced(page: str, name: str, block: str) -> str:
    """The page with this flight's block between its markers. ValueError where they are missing."""
    begin, end = f"<!-- compare: {name} -->", f"<!-- end compare: {name} -->"
    if begin not in page or end not in page:
        raise ValueError(f"{PAGE}: no markers {begin} and {end}")
    before, rest = page.split(begin, 1)
    return before + begin + "\n" + block + "\n" + end + rest.split(end, 1)[1]


def main() -> int:
    """Run all of them, one after the other: they are timed."""
    page = PAGE.read_text(encoding="utf-8")
    for name, words in FLIGHTS.items():
        got = printed(words)
        if got is None:
            print(f"{name}: not here, left as it stands", file=sys.stderr)
            continue
        block = f"```\n$ {got[0]}\n{got[1]}\n```"
        print(block, flush=True)
        page = replaced(page, name, block)
    if "--write" in sys.argv[1:]:
        PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
