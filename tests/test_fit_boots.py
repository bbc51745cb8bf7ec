"""What a fit makes of a .tlog with several vehicles, reboots or a clock that leaps in it: each as if it were alone."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from damaged_logs import flown

from magmav.fitting import fit
from magmav.mavlink.codec import Codec

Frame = tuple[int, bytes]  # UNIX time in us, frame


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    return list(framed(flown(tmp_path_factory.mktemp("flown"), 90.0)["tlog"]))


@pytest.fixture(scope="module")
def alone(flight: list[Frame], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The vehicle's entry where nothing else is in the file."""
    (vehicle,) = fitted(tmp_path_factory.mktemp("alone"), flight)
    assert vehicle["compasses"][0]["fit"]["new_offsets_mg"]
    return vehicle


def framed(data: bytes) -> Iterator[Frame]:
    """A whole tlog's records."""
    at = 0
    while at < len(data):
        head = data[at + 8 :]
        size = 12 + head[1] + 13 * (head[2] & 1) if head[0] == 0xFD else 8 + head[1]
        yield int.from_bytes(data[at : at + 8], "big"), head[:size]
        at += 8 + size


def fitted(folder: Path, frames: list[Frame]) -> list[dict[str, Any]]:
    path = folder / "flight.tlog"
    path.write_bytes(b"".join(us.to_bytes(8, "big") + frame for us, frame in frames))
    vehicles: list[dict[str, Any]] = fit(path)["vehicles"]
    return vehicles


def spoken_by(system: int, frames: list[Frame]) -> list[Frame]:
    """The same words from another vehicle."""
    codec = Codec()
    out = []
    for us, frame in frames:
        for message in codec.decode(frame, "", whole=True):
            component = message.get_srcComponent()
            mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
            mav.seq = message.get_seq()
            out.append((us, bytes(message.pack(mav))))
    return out


@pytest.mark.long
def test_two_vehicles_in_one_tlog_are_fitted_each_as_if_alone(
    flight: list[Frame], alone: dict[str, Any], tmp_path: Path
) -> None:
    late = [(us + 3_000, frame) for us, frame in spoken_by(7, flight)]
    both = fitted(tmp_path, sorted([*flight, *late], key=lambda one: one[0]))
    assert [v["system"] for v in both] == [alone["system"], 7]
    for vehicle in both:
        assert vehicle["flights"] == alone["flights"]
        assert vehicle["compasses"] == alone["compasses"]


def test_after_a_reboot_within_the_file_the_last_flight_counts_as_if_alone(
    flight: list[Frame], alone: dict[str, Any], tmp_path: Path
) -> None:
    on_us = flight[-1][0] - flight[0][0] + 20_000_000
    (vehicle,) = fitted(tmp_path, [*flight, *((us + on_us, frame) for us, frame in flight)])
    assert vehicle["reboots"] == 1
    was, now = alone["compasses"][0]["fit"], vehicle["compasses"][0]["fit"]
    assert now["state"] == was["state"]
    for name in ("new_offsets_mg", "sigma_mg", "span_s"):
        # The date is two minutes later, and so is the field of the Earth.
        assert now[name] == pytest.approx(was[name], abs=0.01)


def test_a_reboot_after_landing_that_taught_nothing_leaves_the_flight_before_it(
    flight: list[Frame], alone: dict[str, Any], tmp_path: Path
) -> None:
    on_us = flight[-1][0] - flight[0][0] + 20_000_000
    idle = [(us + on_us, frame) for us, frame in flight if us - flight[0][0] < 4_000_000]
    (vehicle,) = fitted(tmp_path, [*flight, *idle])
    assert vehicle["reboots"] == 1
    assert vehicle["compasses"][0]["fit"]["new_offsets_mg"] == alone["compasses"][0]["fit"]["new_offsets_mg"]
