"""What was chosen in flight by parameter, kept across restarts beside the store.

A file of its own, not a table of the store: it is read and deleted by hand as easily as the configuration, it never
waits for a lock of the store, and the store's format does not hang on it. It is replaced as a whole, so a kill leaves
the old one or the new one. The configuration file is never touched.

Who wins: each choice is kept with what the configuration (file and command line) said for that key when it was made,
and holds only while the configuration still says that. Whoever edits the file later is heard again: the latest word
counts. Set a parameter back to what the configuration says and its choice is gone.
"""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import Any

from magmav.settings import Knob, Settings, SettingsError, knobs, with_value

FORMAT = 1
_log = logging.getLogger("magmav")
_SECOND = 1_000_000_000
_KNOBS = {f"{k.section}.{k.key}": k for k in knobs() if k.param}


def beside(store: Path, system: int) -> Path:
    """Where the choices of this vehicle are kept, for everybody who works with this store."""
    return store.with_name(f"{store.name}-choices-{system}.json")


class Choices:
    """The choices of one vehicle. For one thread; it reads no clock, ``now_ns`` is the link's.

    path : None until the vehicle is known; what is chosen before waits.
    problem : why the last attempt to keep something failed, or "".
    """

    def __init__(self, path: Path | None, configured: Settings) -> None:
        self.path = path
        self.problem = ""
        self._configured = configured
        self._fresh: dict[str, dict[str, Any] | None] = {}  # chosen here and not kept yet; None: none any more
        self._next_ns: int | None = None

    def settings(self) -> Settings:
        """The configuration with the choices that hold. What cannot be read or used is left out, and logged."""
        settings = self._configured
        for name, kept in (self._read() | self._fresh).items():
            if kept is None:
                continue
            knob = _KNOBS.get(name)
            if knob is None:
                _log.warning("%s: no setting called %s any more; left out", self.path, name)
            elif kept.get("over") != _value(self._configured, knob):
                said = _value(self._configured, knob)
                _log.warning("%s = %s was chosen by %s; the configuration changed since: %s",
                             name, kept.get("value"), knob.param, said)  # fmt: skip
            else:
                settings = self._with(settings, knob, kept.get("value"))
        return settings

    def chose(self, section: str, key: str, value: object, now_ns: int) -> None:
        """Keep this: at once, but no more often than once a second; then ``poll`` does."""
        name = f"{section}.{key}"
        if name not in _KNOBS:
            raise ValueError(f"{name}: no setting of that name can be chosen in flight")
        over = _value(self._configured, _KNOBS[name])
        self._fresh[name] = None if value == over else {"value": value, "over": over}
        self.poll(now_ns)

    def poll(self, now_ns: int) -> None:
        """Keep what waits, if it is time."""
        if self._fresh and (self._next_ns is None or now_ns >= self._next_ns):
            self._next_ns = now_ns + _SECOND
            self.keep()

    def keep(self) -> None:
        """Write what waits, now. A failure is logged and stays in ``problem``; what waits is tried again."""
        if not self._fresh or self.path is None:
            return
        try:
            held = self._read(strict=True) | self._fresh
            _replace(self.path, {name: kept for name, kept in held.items() if kept is not None})
        except (OSError, ValueError) as error:
            if str(error) != self.problem:
                _log.error("%s: choices not kept: %s", self.path, error)
            self.problem = str(error)
            return
        self.problem = ""
        self._fresh.clear()

    def _with(self, settings: Settings, knob: Knob, value: object) -> Settings:
        try:
            return with_value(settings, knob.section, knob.key, value)
        except SettingsError as error:
            _log.warning("%s: %s; left out", self.path, error)
            return settings

    def _read(self, *, strict: bool = False) -> dict[str, dict[str, Any] | None]:
        """name -> value and over; empty when there is none. ``strict``: ValueError on what a write would destroy."""
        if self.path is None:
            return {}
        try:
            text = self.path.read_bytes()
        except FileNotFoundError:
            return {}
        except OSError as error:
            if strict:
                raise
            _log.warning("%s: cannot be read: %s", self.path, error.strerror)
            return {}
        try:
            held = json.loads(text)
            found = held["format"], dict(held["choices"])
            if not all(isinstance(kept, dict) for kept in found[1].values()):
                raise TypeError("a choice without value")
        except (ValueError, KeyError, TypeError) as error:
            _log.warning("%s: cannot be understood (%s); as if there were none", self.path, error)
            return {}
        if found[0] == FORMAT:
            return found[1]
        if strict:
            raise ValueError(f"format {found[0]} is not this magmav's {FORMAT}")
        _log.warning("%s: format %s is not this magmav's %s; left alone", self.path, found[0], FORMAT)
        return {}


def _value(settings: Settings, knob: Knob) -> Any:
    return getattr(getattr(settings, knob.section), knob.key)


def _replace(path: Path, choices: dict[str, Any]) -> None:
    """The whole file at once, on disk when this returns."""
    text = json.dumps({"format": FORMAT, "choices": choices}, indent=1, sort_keys=True, allow_nan=False)
    new = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        with new.open("w", encoding="ascii") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
