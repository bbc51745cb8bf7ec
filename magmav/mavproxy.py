# SPDX-License-Identifier: GPL-3.0-or-later
#
# This file imports MAVProxy, which is licensed under the GNU General Public License version 3 or later, and is
# therefore licensed under the same terms. You may redistribute it and/or modify it under those terms. It comes
# without any warranty. The text of the licence is in LICENSES/GPL-3.0-or-later.txt.
# The rest of magmav is Apache-2.0 and never imports this file.
"""``module load magmav.mavproxy``: magmav's commands in MAVProxy's console, on MAVProxy's own links.

A thin shim: frames in, frames out, words in, lines out. All else is magmav/plugin.py. Settings are read from the
file that MAGMAV_CONFIG names, if it is set; the record of writes is where ``magmav history`` looks too.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from MAVProxy.modules.lib import mp_module

from magmav.geomag import world_magnetic_model
from magmav.host_signing import HostKey, HostSigning
from magmav.link.fed import FedLink
from magmav.plugin import COMMANDS, Plugin
from magmav.settings import SettingsError, load
from magmav.store import default_path
from magmav.whereabouts import is_autopilot

# MAVProxy finds a module again, to unload it, by the name it was loaded with.
NAME = "magmav.mavproxy"
_UNKNOWN = "mavproxy:unknown"


class MagmavModule(mp_module.MPModule):  # type: ignore[misc]  # MAVProxy ships no types
    """Feeds a Plugin. MAVProxy calls it from one thread, but for ``unload``."""

    def __init__(self, mpstate: Any) -> None:
        # Heartbeats of every component and vehicle: who else is there matters for writing.
        super().__init__(mpstate, NAME, "keeps the compass calibrated", multi_vehicle=True)
        chosen = os.environ.get("MAGMAV_CONFIG")
        try:
            settings = load(Path(chosen) if chosen else None)
        except SettingsError as error:
            raise ImportError(f"MAGMAV_CONFIG: {error}") from None  # the one error MAVProxy shows and survives
        self.link = FedLink("mavproxy")
        self.signing: dict[str, HostSigning] = {}
        self.plugin = Plugin(self.link, settings, world_magnetic_model, default_path())
        self.add_command("magmav", self.cmd_magmav, "keep the compass calibrated", list(COMMANDS))

    def mavlink_packet(self, packet: Any) -> None:
        """A message MAVProxy took from one of its links."""
        if packet.get_type() == "BAD_DATA":
            return
        if is_autopilot(packet):
            self.plugin.vehicle(packet.get_srcSystem())
        route = self._route(packet)
        frame = self._signing_of(route).heard(bytes(packet.get_msgbuf()), self._key_of(route))
        if frame is not None:
            self.link.push(frame, route)

    def idle_task(self) -> None:
        """Called many times a second: send what is due, show what is new."""
        self._flush()
        self.plugin.follow(self.target_system)  # `vehicle N`, or the first one MAVProxy heard
        for line in self.plugin.lines():
            self.show(line)

    def cmd_magmav(self, args: list[str]) -> None:
        """``magmav ...`` in the console."""
        self.plugin.command(args)

    def unload(self) -> None:
        """End the work, and give back the message intervals that were asked for."""
        self.remove_command("magmav")
        if not self.plugin.stop():
            self.show("still at work; its last words are lost")
        self.idle_task()
        super().unload()

    def show(self, line: str) -> None:
        self.console.writeln(f"magmav: {line}")

    def _flush(self) -> None:
        for data, route in self.link.take():
            for master in self.mpstate.mav_master:
                name = _name(master)
                if route in ("", name):
                    try:
                        master.write(self._signing_of(name).sent(data, _key(master)))
                    except OSError:
                        self.link.counts["send errors"] += 1

    def _signing_of(self, route: str) -> HostSigning:
        return self.signing.setdefault(route, HostSigning())

    def _key_of(self, route: str) -> HostKey | None:
        """The key of the link of this route; where the link is not known, of any that has one."""
        keys = [_key(m) for m in self.mpstate.mav_master if route in (_name(m), _UNKNOWN)]
        return next((key for key in keys if key is not None), None)

    def _route(self, packet: Any) -> str:
        """Which of MAVProxy's links it came over. Modules are not told, but each link keeps its latest messages."""
        masters = self.mpstate.mav_master
        if len(masters) == 1:
            return _name(masters[0])
        for master in masters:
            state = master.sysid_state.get(packet.get_srcSystem())
            latest = None if state is None else state.messages.get(packet.get_type())
            # MAVProxy may keep a copy of the message, but the bytes in it are the same object.
            if latest is not None and latest.get_msgbuf() is packet.get_msgbuf():
                return _name(master)
        return _UNKNOWN  # never pinned as the vehicle's while a known link brings it


def _key(master: Any) -> HostKey | None:
    """How MAVProxy signs on this link, now: `signing setup`, `key` and `disable` may come at any time."""
    signing = master.mav.signing
    if not signing.sign_outgoing or signing.secret_key is None:
        return None
    return HostKey(bytes(signing.secret_key), signing.link_id, signing.timestamp)


def _name(master: Any) -> str:
    return f"mavproxy:{master.linknum + 1}"


def init(mpstate: Any) -> MagmavModule:
    """What MAVProxy calls to load a module."""
    return MagmavModule(mpstate)
