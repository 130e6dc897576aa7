"""Fixtures of the page's tests: a browser, and programs that end with them."""

from __future__ import annotations

import pytest
from page_kit import Programs, chromium


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def programs():
    programs = Programs()
    yield programs
    programs.close()
