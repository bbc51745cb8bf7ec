"""A refusal names what was asked for by the names this autopilot has."""

from __future__ import annotations

from pathlib import Path

import pytest
from fleet_rig import Exchange, S
from memory_flight import earth_model
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Reason
from magmav.link import Packet
from magmav.live import Session, transact
from magmav.settings import Settings
from magmav.store import Store


class Silent(Exchange):
    """A vehicle that says who it is, and answers nothing."""

    def __init__(self, kind: int) -> None:
        super().__init__()
        self.kind, self.routes = kind, ("udp:1",)

    def packets(self):
        mav = dialect.MAVLink(None, 1, 1)
        for second in range(40):
            beat = dialect.MAVLink_heartbeat_message(2, self.kind, 1, 0, 4, 3)
            yield Packet((5 + second) * S, bytes(beat.pack(mav)), "udp:1")


@pytest.mark.parametrize(("kind", "name"), [(3, "COMPASS_OFS_X"), (12, "CAL_MAG0_XOFF")])
def test_a_refusal_names_the_parameters_of_this_autopilot(tmp_path: Path, kind: int, name: str) -> None:
    link = Silent(kind)
    with Store(tmp_path / "s.sqlite") as store:
        session = Session.on(link, Settings(), earth_model, store, ask=False)
        said = transact(
            session,
            link,
            1,
            lambda device: Reason.NOTHING_TO_DO,
            confirm=None,
            dry=False,
            wait_s=10.0,
            progress=lambda text: None,
        )
    assert said["result"] == "REFUSED" and said["reasons"][0]["code"] == "UNKNOWN_PARAM"
    assert name in said["detail"] and ("COMPASS" in said["detail"]) == (kind == 3)
