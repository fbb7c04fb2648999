"""Waiting in tests: poll for a condition, or repeat an action until its effect is seen.

Neither depends on the machine's speed: the only limit ends a test that hangs.
"""

import time
from collections.abc import Callable

HANG_LIMIT = 120.0
"""Seconds after which a wait counts as hanging; more than ten times the slowest wait on an idle machine."""


def wait_until(
    condition: Callable[[], bool],
    *,
    what: str,
    pause: Callable[[float], object] = time.sleep,
    limit: float = HANG_LIMIT,
) -> None:
    """Poll until `condition` holds; fail with `what` after `limit` seconds."""
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end, f"waited {limit:.0f} s for {what}"
        pause(0.1)


def act_until(
    action: Callable[[], object],
    effect: Callable[[], bool],
    *,
    what: str,
    pause: Callable[[float], object] = time.sleep,
) -> None:
    """Repeat `action` until `effect` holds; do nothing if it holds already.

    The time between repetitions doubles from 5 seconds. `action` must be safe to repeat.
    """
    end, between = time.monotonic() + HANG_LIMIT, 5.0
    while not effect():
        assert time.monotonic() < end, f"repeated an action for {HANG_LIMIT:.0f} s, waiting for {what}"
        action()
        again = time.monotonic() + between
        while time.monotonic() < again and not effect():
            pause(0.1)
        between *= 2
