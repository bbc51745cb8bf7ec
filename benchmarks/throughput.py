"""How fast the live path is: bytes in to Records out, against pymavlink's bare parse of the same bytes.

`make bench`. Both run in one process, in turn, best of three, so that the ratio stands whatever the machine.
The bytes are real recordings where they are (MAGMAV_DATA or ../shared/data), and a simulated flight.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from magmav_sim import SimulatedLink, Simulation, load_scenario
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.console import Console
from rich.table import Table

from magmav.core.types import Reading, Record
from magmav.geomag import world_magnetic_model
from magmav.link import Packet
from magmav.link.memory import MemoryLink
from magmav.link.tlog import TlogLink
from magmav.live import Session
from magmav.pipeline import Pipeline
from magmav.service import Service
from magmav.settings import Settings
from magmav.store import Store

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
_RECORDINGS = {
    "thor75.tlog, 1 compass": _DATA / "flights" / "thor75.tlog",
    "copter-fig8.tlog, 3 compasses": _DATA / "sitl" / "copter-fig8.tlog",
}
_ROUNDS = 3


@dataclass(slots=True)
class Stretch:
    """One recording in memory, as packets."""

    packets: list[Packet]
    unix_offset_ns: int


class _Again(MemoryLink):
    """A link that yields packets already in memory."""

    def __init__(self, stretch: Stretch) -> None:
        super().__init__("bench", lambda: 0, datagrams=True, unix_offset_ns=stretch.unix_offset_ns)
        self._stretch = stretch

    def packets(self) -> Iterator[Packet]:
        return iter(self._stretch.packets)


def recorded(path: Path) -> Stretch:
    """A tlog in memory."""
    link = TlogLink(path)
    packets = [p for p in link.packets() if p.data]
    return Stretch(packets, link.unix_offset_ns)


def simulated(scenario: str) -> Stretch:
    """What a companion hears of a simulated flight."""
    link = SimulatedLink(Simulation(load_scenario(scenario)))
    packets: list[Packet] = []
    with TemporaryDirectory() as folder, Store(Path(folder) / "bench.sqlite") as store:
        session = Session.on(link, Settings(), world_magnetic_model, store)
        for packet in link.packets():
            session.service.turn(packet)
            if packet.data:
                packets.append(packet)
    return Stretch(packets, link.unix_offset_ns)


def whole_path(stretch: Stretch) -> tuple[int, int]:
    """Bytes in, Records out. (messages decoded or checked, magnetometer samples)."""
    samples = 0

    def count(reading: Reading, record: Record | None) -> None:
        nonlocal samples
        samples += record is not None

    pipeline = Pipeline(Settings(), world_magnetic_model, stretch.unix_offset_ns)
    service = Service(_Again(stretch), pipeline, watchers=[count])
    service.run()
    return service.hearing.codec.counts["messages"] + service.hearing.codec.counts["skipped"], samples


def bare_parse(stretch: Stretch) -> tuple[int, int]:
    """pymavlink's own parser over the same packets."""
    mav: Any = dialect.MAVLink(None)
    mav.robust_parsing = True
    messages = 0
    for packet in stretch.packets:
        messages += len(mav.parse_buffer(packet.data) or ())
    return messages, 0


def timed(work: Callable[[Stretch], tuple[int, int]], stretch: Stretch) -> tuple[float, int, int]:
    """Seconds of processor time, and what the work counted."""
    begun = time.process_time()
    messages, samples = work(stretch)
    return time.process_time() - begun, messages, samples


def main() -> int:
    """Measure and print the table."""
    progress = Console(stderr=True)
    stretches = {name: recorded(path) for name, path in _RECORDINGS.items() if path.is_file()}
    stretches |= {"simulated three_compasses, 3": simulated("three_compasses")}
    table = Table(title=f"Live path, bytes in to records out; best of {_ROUNDS}, processor time")
    for head in ("input", "messages", "magmav msg/s", "pymavlink parse msg/s", "ratio", "samples", "us a sample"):
        table.add_column(head, justify="left" if head == "input" else "right")
    for name, stretch in stretches.items():
        ours, bare = [], []
        for number in range(_ROUNDS):
            progress.print(f"{name}: round {number + 1} of {_ROUNDS}")
            ours.append(timed(whole_path, stretch))
            bare.append(timed(bare_parse, stretch))
        ours_s, messages, samples = min(ours)
        bare_s, bare_messages, _ = min(bare)
        ours_rate, bare_rate = messages / ours_s, bare_messages / bare_s
        ratio, each_us = f"{ours_rate / bare_rate:.2f}", f"{1e6 * ours_s / max(samples, 1):.0f}"
        table.add_row(name, f"{messages}", f"{ours_rate:.0f}", f"{bare_rate:.0f}", ratio, f"{samples}", each_us)
    Console(width=140).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
