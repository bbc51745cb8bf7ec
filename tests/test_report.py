"""The report: all that the JSON says, whatever the log's texts are, with nothing fetched from anywhere."""

from __future__ import annotations

import copy
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from magmav_sim import Simulation, load_scenario
from magmav_sim.recorder import Recorder, unattended
from report_entry import compass, entry

from magmav.cli import main
from magmav.view.records import ViewError
from magmav.view.report import report_html, write_report
from magmav.view.report_page import CSS
from magmav.view.report_svg import AFTER, AXIS_COLOURS, BEFORE, FAINT, INK, Panel, ticks

PAGE = report_html(entry())
_NO_END = {"meta", "br"}


class Seen(HTMLParser):
    """A page as a browser takes it: tags in order, attributes, text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in _NO_END:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def shown(page: str) -> str:
    """The page without the JSON at its end: what a reader looks at."""
    head, found, _ = page.partition("<pre>")
    assert found
    return head


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where every single value stands; of the points of a series the first, one in the middle and the last."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    elif isinstance(value, list):
        few = range(len(value)) if len(value) <= 22 else (0, len(value) // 2, len(value) - 1)
        for i in few:
            yield from leaves(value[i], (*path, i))
    else:
        yield path


def put(where: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with this one value in another's place."""
    out = copy.deepcopy(where)
    inner = out
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return out


def at(where: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        where = where[key]
    return where


def other(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}Q"
    return None if value is None else value + 7


FIT = ("vehicles", 0, "compasses", 0, "fit")
# A deviation card has eight rows and the overlay is the current where that is known.
UNSHOWN = {(*FIT, "series", "throttle")}


def single() -> Any:
    """The entry with its first compass alone."""
    document = entry()
    del document["vehicles"][1], document["vehicles"][0]["compasses"][1]
    return document


def test_AT_4a_the_page_holds_the_whole_json():
    text = "".join(Seen(PAGE).text)
    assert json.loads(text[text.index('{"source"') :]) == entry()


def test_AT_4a_whatever_value_of_a_fit_changes_the_readable_part_of_the_page_changes():
    """Old and new values, held-out errors, deviation, data source, time span, version: nothing is left out."""
    document = single()
    before = shown(report_html(document))
    places = [(*FIT, *p) for p in leaves(at(document, FIT))]
    places += [(key, *p) for key in ("file", "made_by", "counts") for p in leaves(document[key], ())]
    assert len(places) > 240
    silent = []
    for place in places:
        old = at(document, place)
        if old is None or place[: len(FIT) + 2] in UNSHOWN:
            continue
        if shown(report_html(put(document, place, other(old)))) == before:
            silent.append(place[-4:])
    assert silent == []


def test_throttle_is_drawn_where_the_current_is_not_known():
    document = put(entry(), (*FIT, "series", "current_a"), None)
    louder = put(document, (*FIT, "series", "throttle", 20), 0.9)
    assert "throttle, on the right" in shown(report_html(document))
    assert shown(report_html(louder)) != shown(report_html(document))


def test_what_is_not_known_is_said_and_never_drawn_as_a_number():
    """Any one value, and any one whole part of a fit, may be null."""
    document = single()
    parts = {place[:n] for place in leaves(at(document, FIT)) for n in range(1, len(place) + 1)}
    for part in sorted(parts, key=str):
        rows = isinstance(part[-1], int) and isinstance(at(document, (*FIT, *part)), dict | list)
        if rows or part == ("state",):
            continue  # a row of a table is there or not, but never null
        page = shown(report_html(put(document, (*FIT, *part), None)))
        assert re.search(r"\b(None|nan|NaN|inf)\b", page) is None, part


@pytest.mark.parametrize("gone", ["fit", "heading", "stored", "device_id", "reasons", "causes", "samples"])
def test_a_compass_of_which_little_is_known_still_has_its_section(gone):
    document = entry()
    document["vehicles"][0]["compasses"] = [compass(1) | {gone: None}]
    assert "Compass 1 of system 1" in report_html(document)


def test_numbers_that_are_not_finite_are_not_known():
    page = report_html(put(entry(), (*FIT, "sigma_mg", 1), float("nan")))
    assert "nan" not in page.lower().replace("finance", "")
    assert "not known" in page


EVIL = "</td></pre></style><script>alert(1)</script><img src=http://x/y onerror=alert(1)>\"' onload='x"


def spoilt(value: Any, text: str) -> Any:
    """The same document with this text in place of every text and every name that comes out of a log."""
    if isinstance(value, dict):
        named = {"stored", "old", "new", "changed", "counts", "link", "codec"}
        return {
            key: {f"{text}{k}": spoilt(v, text) for k, v in inner.items()}
            if key in named and isinstance(inner, dict)
            else spoilt(inner, text)
            for key, inner in value.items()
        }
    if isinstance(value, list):
        return [spoilt(v, text) for v in value]
    return text if isinstance(value, str) else value


def test_script_in_the_texts_and_names_of_a_log_does_no_harm():
    page = report_html(spoilt(entry(), EVIL))
    seen = Seen(page)
    assert "script" not in seen.tags and "img" not in seen.tags
    assert not [a for a in seen.attributes if a[1].startswith("on") or a[1] == "src"]
    assert "alert(1)" in "".join(seen.text)  # it is there, as text
    assert seen.open == []


@given(st.text(st.characters(), max_size=40))
@settings(max_examples=12, deadline=None)
def test_no_text_changes_the_tags_of_the_page(text):
    """Lone surrogates, controls and marks that turn a line round included: a path may hold any of them."""
    tame, wild = Seen(report_html(spoilt(entry(), "x"))), Seen(report_html(spoilt(entry(), f"x{text}")))
    assert wild.tags == tame.tags
    assert [a[:2] for a in wild.attributes] == [a[:2] for a in tame.attributes]
    report_html(spoilt(entry(), text)).encode()


def test_nothing_is_fetched():
    seen = Seen(PAGE)
    assert not [a for a in seen.attributes if a[1] in ("src", "srcset", "data", "action", "poster", "xlink:href")]
    links = [value for _, name, value in seen.attributes if name == "href"]
    ids = [value for _, name, value in seen.attributes if name == "id"]
    assert links and all(link.startswith("#") and link[1:] in ids for link in links)
    assert len(ids) == len(set(ids))
    assert "http:" not in PAGE and "https:" not in PAGE and "//" not in PAGE
    assert "url(" not in CSS and "@import" not in CSS
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(seen.tags)
    policy = [v for _, n, v in seen.attributes if n == "content" and "default-src" in v]
    assert policy == ["default-src 'none'; style-src 'unsafe-inline'"]


def test_the_same_entry_gives_the_same_bytes(tmp_path):
    for name in ("a.html", "b.html"):
        write_report(entry(), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes() == PAGE.encode()


def test_every_picture_is_told_in_words_too():
    seen = Seen(PAGE)
    roles = [value for tag, name, value in seen.attributes if (tag, name) == ("svg", "role")]
    told = [value for tag, name, value in seen.attributes if (tag, name) == ("svg", "aria-label")]
    assert roles == ["img"] * 10 and len(told) == 10  # five a compass
    assert all(re.search(r"\d", t) for t in told)


def luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def test_contrast_on_white():
    """WCAG 2.1: text 4.5 to 1, what is drawn 3 to 1."""
    texts = set(re.findall(r"[;{]color:(#[0-9a-f]{6})", CSS))
    assert len(texts) >= 3
    for colour, least in [*((c, 4.5) for c in texts), *((c, 3.0) for c in (BEFORE, AFTER, FAINT, INK, *AXIS_COLOURS))]:
        assert 1.05 / (luminance(colour) + 0.05) >= least, colour


def test_every_heading_error_names_its_reference():
    page = shown(PAGE)
    for start in (m.start() for m in re.finditer(r"Heading error", page)):
        near = page[start : start + 400]
        assert "GPS yaw" in near or "not known" in near or "on eight headings" in near or "held out" in near, near


def test_the_verdict_is_plain_words_with_causes_and_what_to_do():
    text = " ".join("".join(Seen(PAGE).text).split())
    assert "Ready. This flight shows what the compass should have stored." in text
    assert "falls from 41.5 to 3.8 degrees RMS on the part of the flight that the fit did not see." in text
    assert "field follows the current" in text and "Move the compass away from the power wires." in text
    assert "Refused. These offsets must not be stored" in text
    assert "a change to that, no values to store" in text  # relative
    assert "this is the one that does not fit the motion" in text
    assert "Nothing was heard from this compass" in text
    assert text.count("Compass 1 of system 7") == 1  # two vehicles


def test_a_fit_that_helps_nothing_is_not_praised():
    worse = put(entry(), (*FIT, "heading", "held_out", "after", "rms_deg"), 43.5)
    worse = put(worse, (*FIT, "advice"), [])
    text = "".join(Seen(report_html(worse)).text)
    assert "does not fall: it goes from 41.5 to 43.5 degrees RMS" in text
    assert "there is no need to change it" in text


def test_lines_are_drawn_where_the_data_are():
    panel = Panel((10.0, 30.0), (-5.0, 5.0))
    panel.line([10.0, 20.0, None, 25.0, 30.0], [0.0, 5.0, 1.0, None, -5.0], AFTER)
    path = re.search(r'd="([^"]+)"', panel.inside[0])
    assert path is not None
    wide, high = panel.right - panel.left, panel.height
    strokes = [[tuple(map(float, p.split())) for p in s.split("L")] for s in path[1].split("M")[1:]]
    assert strokes == [[(0.0, high / 2), (wide / 2, 0.0)], [(wide, high)]]  # broken where nothing is known


@given(st.floats(-1e4, 1e4), st.floats(1e-2, 1e4), st.integers(2, 7))
@settings(max_examples=60, deadline=None)
def test_ticks_are_round_within_reach_and_as_many_as_wanted(low, reach, wanted):
    marks = ticks(low, low + reach, wanted)
    assert all(low - 1e-6 * reach <= m <= low + reach * (1 + 1e-6) for m in marks)
    assert len(marks) <= wanted + 1
    steps = {round((b - a) / reach, 6) for a, b in pairwise(marks)}
    assert len(steps) <= 1


@pytest.mark.parametrize("name", ["hill.bin", "report", "hill.tlog"])
def test_a_name_that_is_no_page_is_refused_and_the_file_left_alone(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"a flight")
    with pytest.raises(ViewError, match=name):
        write_report(entry(), path)
    assert path.read_bytes() == b"a flight"


def test_a_path_that_cannot_be_written_is_named_and_nothing_stays_behind(tmp_path):
    (tmp_path / "taken.html").mkdir()
    for path in (tmp_path / "missing" / "a.html", tmp_path / "taken.html"):
        with pytest.raises(ViewError, match=re.escape(str(path))):
            write_report(entry(), path)
    assert [p.name for p in tmp_path.rglob("*")] == ["taken.html"]


_TOO_LITTLE_ROOM = """
import resource, signal, sys
from report_entry import entry
from magmav.view.records import ViewError
from magmav.view.report import write_report
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    write_report(entry(), sys.argv[1])
except ViewError as error:
    sys.exit(f"refused: {error}")
"""


def test_a_disk_that_is_full_leaves_the_report_of_before(tmp_path):
    path = tmp_path / "a.html"
    path.write_text("the old one")
    run = subprocess.run(
        [sys.executable, "-c", _TOO_LITTLE_ROOM, str(path)],
        env={"PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode == 1 and "refused:" in run.stderr and "a.html" in run.stderr
    assert path.read_text() == "the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["a.html"]


def test_S20_a_change_is_followed_by_a_restart_and_a_wait_before_a_take_off():
    for advice in ([], ["load the parameter file"]):
        text = " ".join(Seen(shown(report_html(put(single(), (*FIT, "advice"), advice)))).text)
        assert "restart the autopilot, wait until it has settled" in text
    learning = put(put(single(), (*FIT, "parameters", "changed"), {}), (*FIT, "state"), "LEARNING")
    assert "restart the autopilot" not in " ".join(Seen(shown(report_html(learning))).text)


def test_a_compass_that_is_not_ready_never_says_write():
    """New values that were not earned stand there to be seen, with what to do with them: nothing."""
    learning = put(single(), (*FIT, "parameters", "changed"), {})
    learning = put(learning, (*FIT, "state"), "LEARNING")
    text = " ".join(Seen(shown(report_html(learning))).text)
    assert text.count("do not write") == 2 and "Do not store these offsets." in text
    assert re.search(r"\bwrite\b", text.replace("do not write", "")) is None


def test_AT_4a_the_command_writes_page_and_json_of_the_same_fit(tmp_path, capsys):
    """Of a simulated flight, turned round into a page: nothing in it is lost, and a wrong name is refused at once."""
    plan = unattended(load_scenario("figure8"))
    plan = msgspec.structs.replace(plan, compasses=[plan.compasses[0]])
    sim, log, page = Simulation(plan), tmp_path / "figure8.bin", tmp_path / "page.html"
    with Recorder(sim, [log]):
        sim.advance(60.0)
    assert main(["fit", str(log), "--json", "--report", str(page)]) == 0
    document = json.loads(capsys.readouterr().out)
    text = "".join(Seen(page.read_text(encoding="utf-8")).text)
    assert json.loads(text[text.index('{"source"') :]) == document["logs"][0]
    before = log.read_bytes()
    assert main(["fit", str(log), "--report", str(log)]) == 2
    assert log.read_bytes() == before
