"""Fixtures for pytest: ``pytest_plugins = ["pbonet.testing.fixtures"]``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ._replay import replay

if TYPE_CHECKING:
    from collections.abc import Callable

    from ._verdict import Verdict


@pytest.fixture
def replayed(request: pytest.FixtureRequest) -> Callable[..., Verdict]:
    """Run a task's code again on a log; a relative path is beside the test's file."""

    def run(path: str | Path, task: str, **more: Any) -> Verdict:  # noqa: ANN401
        __tracebackhide__ = True
        return replay(Path(request.path).parent / path, task, **more)

    return run
