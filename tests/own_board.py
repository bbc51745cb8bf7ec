"""Our parameters over real settings, without a vehicle: for tests of what they say and take."""

from __future__ import annotations

from magmav.mavlink.entry import Entry
from magmav.own_params import entries, meant
from magmav.settings import Settings, SettingsError, with_value


class OwnBoard:
    """A Board whose choices go into ``settings`` and whose wishes go into ``asked``."""

    def __init__(self) -> None:
        self.settings = Settings()
        self.confirm = 0.0
        self.result = 0.0
        self.asked: list[tuple[str, int]] = []
        self.entries: list[Entry] = entries(self, lambda: 0)
        self._by_name = {entry.name: entry for entry in self.entries}

    def record(self, compass: int, now_ns: int) -> None:
        return None

    def request_upload(self, compass: int, now_ns: int) -> None:
        self.asked.append(("upload", compass))

    def request_restore(self, compass: int, now_ns: int) -> None:
        self.asked.append(("restore", compass))

    def choose(self, section: str, key: str, value: float) -> bool:
        try:
            self.settings = with_value(self.settings, section, key, meant(section, key, value))
        except SettingsError:
            return False
        return True

    def value(self, name: str) -> float:
        return self._by_name[name].get()

    def set(self, name: str, value: float) -> bool:
        put = self._by_name[name].set
        assert put is not None, name
        return put(value, 0)
