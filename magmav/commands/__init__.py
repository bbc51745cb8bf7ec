"""What each command does, from parsed options to an exit code. Results go to standard output, progress to error."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from magmav.commands.common import Refused as Refused
from magmav.commands.fit import fit
from magmav.commands.live import history, restore, run, upload
from magmav.commands.other import demo, settings
from magmav.commands.recordings import compare, replay

COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "demo": demo,
    "run": run,
    "replay": replay,
    "compare": compare,
    "fit": fit,
    "upload": upload,
    "restore": restore,
    "history": history,
    "settings": settings,
}
