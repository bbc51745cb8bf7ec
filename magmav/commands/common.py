"""What every command does alike: settings from options, results to standard output, progress to standard error."""

from __future__ import annotations

import argparse
import gc
import json
import logging
import math
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from magmav.mavlink.signing import Signing, StampFile, read_key, readable_by_others
from magmav.settings import Settings, checked, load

_log = logging.getLogger("magmav")
Result = dict[str, Any]


class Refused(Exception):
    """An action that was asked for and not done."""


def settings_of(o: argparse.Namespace) -> Settings:
    settings = load(o.config)
    for option, section, key in (
        ("system", "vehicle", "system"),
        ("lat", "place", "lat_deg"),
        ("lon", "place", "lon_deg"),
        ("alt", "place", "alt_m"),
    ):
        value = getattr(o, option, None)
        if value is not None:
            part = msgspec.structs.replace(getattr(settings, section), **{key: value})
            settings = msgspec.structs.replace(settings, **{section: part})
    if getattr(o, "bench", False):
        settings = msgspec.structs.replace(settings, learn=msgspec.structs.replace(settings.learn, on_ground=True))
    settings = msgspec.convert(msgspec.to_builtins(settings), Settings)
    return checked(settings, "command line")


def signer_of(o: argparse.Namespace, store: Path) -> Signing | None:
    """What signs and checks, where a key file was given. Its timestamps are kept beside the store, per link id."""
    if o.key_file is None:
        return None
    key = read_key(o.key_file)
    if readable_by_others(o.key_file):
        _log.warning("%s: others on this machine may read this key; chmod 600 it", o.key_file)
    return Signing(key, o.link_id, StampFile(store.with_name(f"signing-{o.link_id}.json")))


def spare_the_collector() -> None:
    """For a command that goes through a file and ends: Samples by the hundred thousand, and no circles among them.

    Looking for circles anyway is a tenth of the time.
    """
    gc.disable()


def show(o: argparse.Namespace, result: Result, view: Callable[[Any], RenderableType]) -> None:
    if o.json:
        sys.stdout.write(json.dumps(finite(result)) + "\n")
    else:
        width = None if sys.stdout.isatty() else 120  # a pipe has no width of its own
        Console(file=sys.stdout, highlight=False, width=width).print(view(result))


def finite(value: Any) -> Any:
    """The same tree with every number that is not finite as None: JSON knows no NaN."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def stderr_console() -> Console:
    return Console(stderr=True, highlight=False)


def progress_bar(stack: ExitStack, name: str) -> Callable[[int, int], None] | None:
    """A bar on standard error, where somebody watches."""
    if not sys.stderr.isatty():
        return None
    bar = stack.enter_context(
        Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=stderr_console())
    )
    task = bar.add_task(name)
    return lambda done, total: bar.update(task, completed=done, total=total)
