"""Open the built documentation in headless Chromium and look for what a reader would see.

    python tests/scripts/check_pages.py docs/_build/html [PAGE ...]

Each page is opened at 1440 and 390 pixels, light and dark, without a network. It fails on errors of
the page, formulas that are not rendered, pages wider than the window, and, on the large screen, on
tables and code that have to be scrolled. Needs the extra ``browser``, and Chromium, whose path the
variable CHROMIUM may name.
"""

import argparse
import functools
import http.server
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

WIDTHS = (1440, 390)
SCHEMES = ("light", "dark")
UNRENDERED = """() => [...document.querySelectorAll('.math')]
    .filter(each => !each.querySelector('mjx-container')).map(each => each.textContent.trim())"""
BAD_FORMULAS = "() => [...document.querySelectorAll('mjx-merror')].map(each => each.textContent)"
OVERFLOW = "() => document.documentElement.scrollWidth - window.innerWidth"
CLIPPED = """() => [...document.querySelectorAll('article table, article pre, article .math')]
    .filter(each => each.getBoundingClientRect().right > window.innerWidth + 1)
    .filter(each => { for (let box = each; box; box = box.parentElement) {
        if (['auto', 'scroll'].includes(getComputedStyle(box).overflowX)) return false; }
        return true; }).map(each => each.textContent.trim().slice(0, 60))"""

SCROLLED = """() => [...document.querySelectorAll('article *')]
    .filter(each => ['auto', 'scroll'].includes(getComputedStyle(each).overflowX))
    .filter(each => each.scrollWidth > each.clientWidth + 1)
    .map(each => each.textContent.trim().slice(0, 60))"""


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, *_: Any) -> None:
        """Be quiet."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of a folder, on this machine."""
    handler = functools.partial(Handler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


def faults_of(page: Any, url: str) -> list[str]:
    """What is wrong with a page at the present width."""
    faults: list[str] = []
    listeners = {
        "pageerror": lambda error: faults.append(f"error: {error}"),
        "requestfailed": lambda request: faults.append(f"not loaded: {request.url}"),
        "console": lambda message: (
            faults.append(f"console: {message.text} {message.location['url']}")
            if message.type == "error" and "favicon" not in message.location["url"]
            else None
        ),
    }
    for event, listener in listeners.items():
        page.on(event, listener)
    page.goto(url, wait_until="load")
    page.evaluate("() => window.MathJax?.startup?.promise")
    page.wait_for_timeout(50)
    faults += [f"formula not rendered: {text}" for text in page.evaluate(UNRENDERED)]
    faults += [f"formula with an error: {text}" for text in page.evaluate(BAD_FORMULAS)]
    faults += [f"cannot be scrolled to: {text}" for text in page.evaluate(CLIPPED)]
    if page.viewport_size["width"] == max(WIDTHS):
        faults += [f"has to be scrolled: {text}" for text in page.evaluate(SCROLLED)]
    overflow = page.evaluate(OVERFLOW)
    if overflow > 1:
        faults.append(f"wider than the window by {overflow} px")
    for event, listener in listeners.items():
        page.remove_listener(event, listener)
    return faults


def check(folder: Path, names: list[str]) -> int:
    """Check pages; the number of those with faults."""
    paths = [folder / name for name in names] or sorted(folder.rglob("*.html"))
    pages = [p for p in paths if "_modules" not in p.parts and "_static" not in p.parts]
    n_bad = 0
    browser_path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chrome")
    with sync_playwright() as playwright, served(folder) as address:
        browser = playwright.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        for width in WIDTHS:
            for scheme in SCHEMES:
                size = {"width": width, "height": 900}
                context = browser.new_context(viewport=size, color_scheme=scheme)
                page = context.new_page()
                for path in pages:
                    name = path.relative_to(folder)
                    faults = faults_of(page, f"{address}/{name}")
                    n_bad += bool(faults)
                    for fault in dict.fromkeys(faults):
                        sys.stdout.write(f"{name} at {width} px, {scheme}: {fault}\n")
                context.close()
        browser.close()
    sys.stdout.write(f"{len(pages)} pages, {n_bad} faulty of {len(pages) * 4} views\n")
    return n_bad


def main() -> int:
    """Check what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="what sphinx-build wrote")
    parser.add_argument("pages", nargs="*", help="pages; default: all")
    options = parser.parse_args()
    return 1 if check(options.folder, options.pages) else 0


if __name__ == "__main__":
    sys.exit(main())
