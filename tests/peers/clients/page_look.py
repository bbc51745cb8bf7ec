"""Opens a page in a real browser: a phone's width, a desk's, paper. Answers with one JSON line.

page_look.py PAGE PDF
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Error, Playwright, sync_playwright

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
MEASURE = """() => ({
  width: document.documentElement.scrollWidth,
  scrolled: [...document.querySelectorAll('.wide')].filter(e => e.scrollWidth > e.clientWidth + 1).length,
  pictures: [...document.querySelectorAll('svg.picture')].map(e => e.getBoundingClientRect().width),
  smallest: Math.min(...[...document.querySelectorAll('svg.picture text')].map(
    e => parseFloat(getComputedStyle(e).fontSize) * e.ownerSVGElement.getBoundingClientRect().width / 400)),
})"""


def browser(play: Playwright) -> Browser:
    """Playwright's own where it was fetched, else the system's."""
    found = [path for name in NAMES if (path := shutil.which(name))]
    for path in (None, *found):
        try:
            return play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        except Error:
            continue
    sys.exit("no browser: neither playwright's nor one of " + ", ".join(NAMES))


def look(page_html: Path, pdf: Path) -> dict[str, Any]:
    out: dict[str, Any] = {"asked": [], "said": []}
    with sync_playwright() as play:
        chrome = browser(play)
        for width in (390, 1200):
            page = chrome.new_page(viewport={"width": width, "height": 844})
            page.on("request", lambda request: out["asked"].append(request.url))
            page.on("console", lambda message: out["said"].append(message.text))
            page.goto(page_html.resolve().as_uri())
            out[str(width)] = page.evaluate(MEASURE)
        page.pdf(path=str(pdf), prefer_css_page_size=True, print_background=True)
        chrome.close()
    return out


if __name__ == "__main__":
    print(json.dumps(look(Path(sys.argv[1]), Path(sys.argv[2]))))
