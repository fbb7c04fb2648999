"""Puts this folder on the path, so that every test can import the tiny models; marks tests that use a browser.

No test may fail because the machine is slow or busy: time limits (pyproject.toml) are there against hangs alone.
"""

import pytest
from hypothesis import HealthCheck, settings

# both are limits on the machine's speed
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests that use a browser."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)
