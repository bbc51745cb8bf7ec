"""Commands that need neither a recording nor a link: the table of settings, and the demo."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import msgspec

from magmav.commands.common import finite, settings_of, show, stderr_console
from magmav.geomag import world_magnetic_model
from magmav.settings import as_toml


def settings(o: argparse.Namespace) -> int:
    """The table of knobs."""
    if o.json:
        from magmav.settings import knobs

        sys.stdout.write(json.dumps(finite([msgspec.to_builtins(k) for k in knobs()])) + "\n")
    else:
        sys.stdout.write(as_toml())
    return 0


def demo(o: argparse.Namespace) -> int:
    """The main job, on a simulated aircraft."""
    from magmav.demo import demo as play
    from magmav.view.table import demo_view

    say = stderr_console()
    with ExitStack() as stack:
        folder = o.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="magmav-demo-")))
        plot = o.plot or (o.out / "demo.png" if o.out is not None else None)
        result = play(
            settings_of(o),
            world_magnetic_model,
            folder,
            seed=o.seed,
            plot=plot,
            progress=lambda text: say.print(text),
        )
        if o.out is None:
            result["folder"] = None
        else:
            (o.out / "demo.json").write_text(json.dumps(finite(result), indent=1) + "\n", encoding="utf-8")
    show(o, result, demo_view)
    if not o.json:
        sys.stdout.write(json.dumps(finite(result)) + "\n")
    good = result["upload"]["result"] == "ALL_NEW" and result["restore"]["result"] == "ALL_OLD"
    return 0 if good else 1
