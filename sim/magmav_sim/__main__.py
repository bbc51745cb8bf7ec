"""``python -m magmav_sim SCENARIO --to LINK``: a simulated vehicle for any ground station or companion.

``--write FILE...`` keeps the flight as .tlog, .bin, .log or .ulg; without ``--to`` it flies as fast as it can.
"""

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
from magmav.link.open import open_link, stays_here
from magmav_sim.recorder import Recorder, kinds, recordable, unattended
from magmav_sim.scenario import ScenarioError, has_second_route, with_autopilot
from magmav_sim.scenario_file import load_scenario, scenario_files
from magmav_sim.serve import serve
from magmav_sim.truth import TruthLog, summary
from magmav_sim.vehicle import Simulation

_WRONG, _NO_INPUT, _NO_LINK = 2, 3, 4
_TICK_S = 0.01
_STRIDE_S = 0.02


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 flown or stopped, 2 wrong arguments, 3 no usable scenario, or nowhere to write, 4 link."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = _parser("--json" in words)
    try:
        options = parser.parse_args(words)
        if options.to is None and not options.write:
            parser.error("want --to LINK, --write FILE or both")
    except SystemExit as leave:  # the parser has said what is wrong, or printed the help
        return _WRONG if leave.code else 0
    try:
        scenario = load_scenario(options.scenario)
        if options.autopilot is not None:
            scenario = with_autopilot(scenario, options.autopilot)
        simulation = Simulation(scenario if options.to else unattended(scenario), options.seed)
    except ScenarioError as error:
        return _fail(_NO_INPUT, str(error), options.json)
    try:
        link = None if options.to is None else open_link(stays_here(options.to), tick_s=_TICK_S)
        second = None if link is None or not has_second_route(scenario) else open_link(options.to, tick_s=_TICK_S)
    except LinkError as error:
        return _fail(_NO_LINK, str(error), options.json)
    first = simulation.truth
    recorder = None
    with ExitStack() as stack:
        truth = None
        if link is not None:
            stack.callback(link.close)
        if second is not None:
            stack.callback(second.close)
        try:
            if options.truth is not None:
                truth = stack.enter_context(TruthLog(options.truth, simulation))
        except OSError as error:
            return _fail(_NO_INPUT, f"--truth {options.truth}: {error.strerror}", options.json)
        try:
            if options.write:
                recorder = stack.enter_context(Recorder(simulation, options.write, fetch=link is None))
            stopped = stack.enter_context(_stopped_by_signal(link))
            if link is None:
                _fly(simulation, truth, stopped)
            else:
                serve(link, simulation, options.speed, truth, stopped.is_set, second)
        except ValueError as error:
            return _fail(_WRONG, f"--write: {error}", options.json)
        except FileExistsError as error:
            return _fail(_NO_INPUT, f"--write {error.filename}: is there already; name another file", options.json)
        except OSError as error:
            where = error.filename or ", ".join(map(str, options.write))
            return _fail(_NO_INPUT, f"--write {where}: {error.strerror}", options.json)
    if options.json:
        written = {} if recorder is None else {"files": [str(path) for path in recorder.files]}
        sys.stdout.write(json.dumps(summary(simulation, first) | written) + "\n")
    return 0


def _fly(simulation: Simulation, truth: TruthLog | None, stopped: threading.Event) -> None:
    """To the end of the scenario, as fast as it goes."""
    while not (simulation.finished or stopped.is_set()):
        simulation.advance(_STRIDE_S)
        if truth is not None:
            truth.sample()


class _Parser(argparse.ArgumentParser):
    """Its complaints are JSON when JSON was asked for."""

    as_json = False

    def error(self, message: str) -> NoReturn:
        raise SystemExit(_fail(_WRONG, f"{message} (see {self.prog} --help)", self.as_json))


def _parser(as_json: bool) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="magmav sim", description="Fly a simulated vehicle that speaks MAVLink as ArduPilot 4.5 or PX4 does."
    )
    parser.as_json = as_json
    parser.add_argument("--json", action="store_true", help="at the end, what was true, as JSON")
    known = ", ".join(scenario_files())
    parser.add_argument("scenario", nargs="?", default="demo", help=f"a .toml file, or one of: {known}")
    parser.add_argument("--to", metavar="LINK", help="on this machine, e.g. udpout:127.0.0.1:14550")
    parser.add_argument(
        "--write",
        type=_recording,
        nargs="+",
        default=[],
        metavar="FILE",
        help=f"keep the flight, by the name's ending: {kinds()}; without --to as fast as it can",
    )
    parser.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="X",
        help="times real time, or max: as answers to PING allow",
    )
    parser.add_argument("--truth", type=Path, metavar="DIR", help="write truth.csv and truth.json there")
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"), help="instead of the scenario's own")
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


def _recording(text: str) -> Path:
    if not recordable(Path(text)):
        raise argparse.ArgumentTypeError(f"want a name that ends in one of {kinds()}; got {text}")
    return Path(text)


def _fail(code: int, text: str, as_json: bool) -> int:
    if as_json:
        sys.stdout.write(json.dumps({"error": {"code": code, "text": text}}) + "\n")
    else:
        sys.stderr.write(f"magmav sim: {text}\n")
    return code


@contextmanager
def _stopped_by_signal(link: Link | None) -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set; a link is closed then, so that no wait outlasts them."""
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()
        if link is not None:
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
