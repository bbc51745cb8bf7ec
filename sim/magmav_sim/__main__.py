"""``python -m magmav_sim SCENARIO --to LINK``: a simulated vehicle for any ground station or companion."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from magmav.link import Link, LinkError
from magmav.link.open import open_link
from magmav_sim.scenario import ScenarioError
from magmav_sim.scenario_file import load_scenario, scenario_files
from magmav_sim.serve import serve
from magmav_sim.truth import TruthLog, summary
from magmav_sim.vehicle import Simulation

_WRONG, _NO_INPUT, _NO_LINK = 2, 3, 4
_TICK_S = 0.01


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 flown or stopped, 2 wrong arguments, 3 no usable scenario or truth directory, 4 link."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        options = _parser("--json" in words).parse_args(words)
    except SystemExit as leave:  # the parser has said what is wrong, or printed the help
        return _WRONG if leave.code else 0
    try:
        simulation = Simulation(load_scenario(options.scenario), options.seed)
    except ScenarioError as error:
        return _fail(_NO_INPUT, str(error), options.json)
    try:
        link = open_link(options.to, tick_s=_TICK_S)
    except LinkError as error:
        return _fail(_NO_LINK, str(error), options.json)
    first = simulation.truth
    with ExitStack() as stack:
        stack.callback(link.close)
        truth = None
        try:
            if options.truth is not None:
                truth = stack.enter_context(TruthLog(options.truth, simulation))
        except OSError as error:
            return _fail(_NO_INPUT, f"--truth {options.truth}: {error.strerror}", options.json)
        stopped = stack.enter_context(_stopped_by_signal(link))
        serve(link, simulation, options.speed, truth, stopped.is_set)
    if options.json:
        sys.stdout.write(json.dumps(summary(simulation, first)) + "\n")
    return 0


class _Parser(argparse.ArgumentParser):
    """Its complaints are JSON when JSON was asked for."""

    as_json = False

    def error(self, message: str) -> NoReturn:
        raise SystemExit(_fail(_WRONG, f"{message} (see {self.prog} --help)", self.as_json))


def _parser(as_json: bool) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="magmav sim", description="Fly a simulated vehicle that speaks MAVLink as ArduPilot 4.5 does."
    )
    parser.as_json = as_json
    parser.add_argument("--json", action="store_true", help="at the end, what was true, as JSON")
    known = ", ".join(scenario_files())
    parser.add_argument("scenario", nargs="?", default="demo", help=f"a .toml file, or one of: {known}")
    parser.add_argument("--to", required=True, metavar="LINK", help="e.g. udpout:127.0.0.1:14550")
    parser.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="X",
        help="times real time, or max: as answers to PING allow",
    )
    parser.add_argument("--truth", type=Path, metavar="DIR", help="write truth.csv and truth.json there")
    parser.add_argument("--seed", type=_seed, metavar="N", help="instead of the scenario's own")
    return parser


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    value = float(text)
    if not 0 < value <= 1000:
        raise argparse.ArgumentTypeError(f"want a number above 0, at most 1000, or max; got {text}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"want 0 or more, got {text}")
    return value


def _fail(code: int, text: str, as_json: bool) -> int:
    if as_json:
        sys.stdout.write(json.dumps({"error": {"code": code, "text": text}}) + "\n")
    else:
        sys.stderr.write(f"magmav sim: {text}\n")
    return code


@contextmanager
def _stopped_by_signal(link: Link) -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set; the link is closed then, so that no wait outlasts them."""
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()
        link.close()

    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
