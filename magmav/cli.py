"""The command line: argv to settings, a link and some views. No logic of its own.

Exit codes: 0 a result was written or the action done, 1 an action was refused, 2 wrong arguments or settings,
3 input missing, unreadable or without what is needed, 4 port or link. With --json the standard output holds one JSON
document and nothing else (`run`: one object a line); errors are {"error": {"code", "text"}}.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from magmav import __version__
from magmav.commands import COMMANDS, Refused
from magmav.link import LinkError
from magmav.settings import SettingsError, knobs

DONE, REFUSED, USAGE, INPUT, PORT = 0, 1, 2, 3, 4
_LINKS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class _Parser(argparse.ArgumentParser):
    """Errors come out as JSON when JSON was asked for."""

    def error(self, message: str) -> NoReturn:
        fail(USAGE, f"{message} (see {self.prog} --help)", "--json" in sys.argv)
        raise SystemExit(USAGE)


def parser() -> argparse.ArgumentParser:
    """Every command and option."""
    top = _Parser(
        prog="magmav",
        description="Keeps a drone's compass calibrated while it flies, and says how sure it is.",
        epilog=__doc__.split("\n\n", 1)[1] if __doc__ else None,
    )
    top.add_argument("--version", action="version", version=f"magmav {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    def add(
        name: str, text: str, *, place: bool = False, store: bool = False, bench: bool = False
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.add_argument("--json", action="store_true", help="JSON on standard output")
        sub.add_argument("-v", "--verbose", action="store_true", help="more on standard error")
        if name not in ("sim", "history", "settings"):
            sub.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML) over the defaults")
        if place:
            sub.add_argument("--lat", type=float, metavar="DEG", help="latitude, for vehicles without GPS")
            sub.add_argument("--lon", type=float, metavar="DEG", help="longitude")
            sub.add_argument("--alt", type=float, metavar="M", help="altitude above mean sea level")
        if bench:
            why = "turned by hand, away from steel: what flies may be ready before it has flown"
            sub.add_argument("--bench", action="store_true", help=why)
        if store:
            sub.add_argument("--store", type=Path, metavar="FILE", help="history and undo (default: user state)")
        return sub

    demo = add("demo", "fly, learn, land, upload, fly again and undo, on a simulated aircraft over real UDP")
    demo.add_argument("--out", type=Path, metavar="DIR", help="keep tlog, truth and picture there")
    demo.add_argument("--seed", type=int, metavar="N", help="another wind, other noise")
    demo.add_argument("--plot", type=Path, metavar="PNG", help="where to draw the picture")

    run = add("run", f"the service on a live link ({_LINKS})", place=True, store=True, bench=True)
    _link(run, several=True)
    run.add_argument("--record", type=Path, metavar="TLOG", help="record the link, both ways")
    run.add_argument("--records", type=Path, metavar="FILE", help="every Record, .jsonl or .csv")
    run.add_argument("--for", dest="for_s", type=float, metavar="S", help="stop after so many seconds")
    run.add_argument("--no-requests", action="store_true", help="do not ask the vehicle for message rates")

    sim = commands.add_parser("sim", help="a simulated vehicle for any ground station or companion", add_help=False)
    sim.add_argument("rest", nargs=argparse.REMAINDER)

    replay = add("replay", "a recording through the same pipeline: what would have been known", place=True, bench=True)
    replay.add_argument("log", type=Path, metavar="LOG", help="a .tlog, .bin, .log or .ulg")
    replay.add_argument(
        "--learn-for", type=float, metavar="S", help="freeze S seconds after take-off and score the rest"
    )
    replay.add_argument("--after-flight", action="store_true", help="the iron of every moment, with all of it known")
    replay.add_argument("--every", type=float, metavar="S", help="what was known every S seconds")
    replay.add_argument("--records", type=Path, metavar="FILE", help="every Record, .jsonl or .csv")
    replay.add_argument("--reference", type=Path, metavar="CSV", help="truth file instead of ATTITUDE yaw")
    replay.add_argument("--plot", type=Path, metavar="PNG", help="offsets, heading errors and field cloud")

    compare = add("compare", "every estimator on one recording or simulated flight, side by side", place=True)
    compare.add_argument("log", type=Path, metavar="LOG", help="a .tlog, .bin, .log or .ulg, or a scenario's name")
    compare.add_argument("--reference", type=Path, metavar="CSV", help="truth file instead of the recording's own yaw")
    compare.add_argument("--only", metavar="NAMES", help="estimators, comma between; default all")
    compare.add_argument("--plot", type=Path, metavar="PNG", help="circles and spheres over the points")
    compare.add_argument("--seed", type=int, metavar="N", help="of a scenario, instead of its own")

    fit = add("fit", "best answer after the flight, as parameter file, report and JSON", place=True, bench=True)
    _fit_options(fit)

    upload = add("upload", "write what was learnt to the vehicle, prove it, or show what would be sent", store=True)
    _link(upload)
    _write_options(upload)
    upload.add_argument("--from", dest="source", type=Path, metavar="JSON", help="result of `magmav replay --json`")
    upload.add_argument("--dry-run", action="store_true", help="show every message, and the code a large change needs")
    upload.add_argument("--confirm-change", type=int, metavar="CODE", help="the code the dry run announced")

    restore = add("restore", "bring back the values from before the last upload", store=True)
    _link(restore)
    _write_options(restore)
    restore.add_argument("--dry-run", action="store_true", help="show every message and send none")

    history = add("history", "every write to a vehicle, and what every flight taught", store=True)
    history.add_argument("--dismiss", type=int, metavar="ID", help="leave a write that was cut short as it is")
    history.add_argument("--limit", type=int, default=20, metavar="N", help="how many (default 20)")

    add("settings", "print every setting with its default, unit and limits, as TOML")
    return top


def _fit_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("logs", type=Path, metavar="LOG", nargs="+", help="a .tlog, .bin, .log or .ulg, or a folder")
    sub.add_argument("--reference", type=Path, metavar="CSV", help="truth file instead of the recording's own yaw")
    sub.add_argument("--soft-iron", action="store_true", help="soft iron too, where the flight shows it")
    sub.add_argument("--scale", action="store_true", help="scale too, where the flight shows it")
    sub.add_argument("--motor", action="store_true", help="motor or current terms too, where the flight shows them")
    sub.add_argument("--params", type=Path, metavar="FILE", help="what changes: .param, or .params for QGC")
    sub.add_argument("--report", type=Path, metavar="HTML", help="one file to show; of one log")
    sub.add_argument("--out", type=Path, metavar="DIR", help="ledger, and table of many logs (default: magmav-fit)")
    sub.add_argument("--jobs", type=int, metavar="N", help="processes for many logs (default: all cores)")
    sub.add_argument("--dask", metavar="ADDRESS", help="an existing Dask cluster instead, for many logs")
    sub.add_argument("--resume", action="store_true", help="only go on from the ledger in --out")
    sub.add_argument("--store", type=Path, metavar="FILE", help="remember what was learnt, for `magmav history`")


def _link(sub: argparse.ArgumentParser, several: bool = False) -> None:
    sub.add_argument("link", metavar="LINK", help=_LINKS, nargs="+" if several else None)
    which = "serve this vehicle only" if several else "the vehicle, where several are heard"
    sub.add_argument("--system", type=int, metavar="ID", help=which)
    key = "sign (MAVLink 2) and believe only what is signed: 32 bytes, hex, base64, or passphrase:WORDS"
    sub.add_argument("--key-file", type=Path, metavar="FILE", help=key)
    # Another one for a single write than for the service that may run beside it: each stream's timestamps only grow.
    number = 191 if several else 190
    sub.add_argument("--link-id", type=int, default=number, metavar="N", help=f"of what we sign (default {number})")


def _write_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--compass", type=int, choices=(1, 2, 3), default=1, help="which compass (default 1)")
    sub.add_argument("--wait", type=float, default=20.0, metavar="S", help="for the vehicle to answer (default 20)")


def fail(code: int, text: str, as_json: bool) -> int:
    """Say what is wrong, once, where the reader looks for it."""
    if as_json:
        sys.stdout.write(json.dumps({"error": {"code": code, "text": text}}) + "\n")
    else:
        sys.stderr.write(f"magmav: {text}\n")
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["sim"]:
        from magmav_sim.__main__ import main as simulate

        return simulate(words[1:])
    options = parser().parse_args(words)
    logging.basicConfig(
        stream=sys.stderr, format="%(message)s", level=logging.DEBUG if options.verbose else logging.WARNING
    )
    return _guarded(options)


def _guarded(options: argparse.Namespace) -> int:
    from magmav_sim.scenario import ScenarioError

    from magmav.demo import DemoError
    from magmav.fitting.cluster import ClusterError
    from magmav.fitting.ledger import LedgerError
    from magmav.live import NoVehicle
    from magmav.logs import LogError
    from magmav.mavlink.signing import SigningError
    from magmav.recording import NothingToLearnFrom
    from magmav.reference import TruthError
    from magmav.saved_result import SavedResultError
    from magmav.store import StoreError
    from magmav.view.records import ViewError

    try:
        result: Any = COMMANDS[options.command](options)
    except (SettingsError, ValueError) as error:
        return fail(USAGE, str(error), options.json)
    except (
        LogError, LedgerError, NothingToLearnFrom, SavedResultError, TruthError, ViewError, ScenarioError, StoreError,
        SigningError,
    ) as error:  # fmt: skip
        return fail(INPUT, str(error), options.json)
    except LinkError as error:
        return fail(INPUT if options.command in ("replay", "compare", "fit") else PORT, str(error), options.json)
    except (NoVehicle, DemoError, ClusterError) as error:
        return fail(PORT, str(error), options.json)
    except Refused as error:
        return fail(REFUSED, str(error), options.json)
    except KeyboardInterrupt:
        return fail(REFUSED, "stopped by the keyboard", options.json)
    return int(result)


def describe_settings() -> str:
    """One line per setting, for --help pages and documentation."""
    return "\n".join(f"{k.section}.{k.key}: {k.text}" for k in knobs())


if __name__ == "__main__":
    sys.exit(main())
