"""The page in the system's Chromium, and servers of it; used by tests of the page.

Screenshots are kept in the folder that PBONET_SCREENSHOTS names.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from watching import END_TIME, clean_folder, wait_for

from pbonet.master.web import application

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
_QUIET = ("background-networking", "component-update", "sync", "gpu")
_LIMIT_MS = 1000 * END_TIME


@contextlib.contextmanager
def chromium():
    """Run a browser without a screen; skip where there is none, or no page."""
    built = (application.DIST / "index.html").is_file()
    if not os.environ.get("CI"):
        if CHROMIUM is None:
            pytest.skip("Chromium is not installed")
        if not built:
            pytest.skip("the page is not built: 'npm ci && npm run build' in web/")
    assert CHROMIUM, "Chromium is not installed"
    assert built, "the page is not built"
    from playwright.sync_api import sync_playwright

    arguments = ["--no-sandbox", *(f"--disable-{one}" for one in _QUIET)]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=arguments, chromium_sandbox=False
        )
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser, url, **settings):
    """Open the page; fail when its scripts raised an error or broke a rule of it."""
    settings = {"viewport": {"width": 1440, "height": 900}, **settings}
    context = browser.new_context(**settings)
    context.set_default_timeout(_LIMIT_MS)
    page = context.new_page()
    faults = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda one: faults.append(one.text) if _is_fault(one) else None)
    page.goto(url)
    page.locator(".card").first.wait_for()
    yield page
    context.close()
    assert faults == []


def _is_fault(message):
    away = "ERR_CONNECTION", "WebSocket connection"  # a server that is away for a time
    return message.type == "error" and not any(one in message.text for one in away)


def keep_picture(page, name):
    """Keep a screenshot where somebody wants them."""
    folder = os.environ.get("PBONET_SCREENSHOTS")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=str(Path(folder) / f"{name}.png"))


class Programs:
    """Programs of the command line in a domain and folders of their own."""

    def __init__(self):
        self.folder = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/tmp"))
        self.shared = Path("/dev/shm") / self.folder.name  # noqa: S108
        self.shared.mkdir(mode=0o700)
        self.domain = f"t{secrets.token_hex(3)}"
        self.env = os.environ | {
            "PBONET_RUN_DIR": str(self.folder),
            "PBONET_SHM_DIR": str(self.shared),
            "PBONET_DOMAIN": self.domain,
        }
        self._started = []

    def begin(self, *words, **settings):
        """Start a program that runs until it is ended."""
        process = subprocess.Popen(
            self._command(words), env=self.env, text=True, **settings
        )
        self._started.append(process)
        return process

    def call(self, *words):
        """Run a program to its end; return what it printed, errors too."""
        done = subprocess.run(
            self._command(words),
            env=self.env,
            check=False,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=2 * END_TIME,
        )
        return done.stdout

    def _command(self, words):
        return [sys.executable, "-m", "pbonet.cli", *map(str, words)]

    def close(self):
        """End everything in the reverse order, and look that nothing is left."""
        for process in reversed(self._started):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.communicate(timeout=2 * END_TIME)
        clean_folder(self.shared, "PBONET_SHM_DIR")
        clean_folder(self.folder, "PBONET_RUN_DIR")


class PageServer:
    """A program ``pbonet web``, and the links that it prints.

    Args:
        programs: Starts it.
        file: What it shows.
        port: The port that it serves; 0: a free one.
    """

    def __init__(self, programs, file, *, port=0):
        self.process = programs.begin(
            "web", file, "--port", port, "--json", stdout=subprocess.PIPE
        )
        self._links = {"operator": queue.Queue(), "observer": queue.Queue()}
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            for role, link in json.loads(line).items():
                self._links[role].put(link)

    def link(self, role="operator"):
        """Return a link that nobody has used."""
        return self._links[role].get(timeout=END_TIME)

    def kill(self):
        """End it as a crash does."""
        self.process.kill()
        wait_for(lambda: self.process.poll() is not None, "the end of the server")
