"""Opening a page in the user's browser, where there is a desktop."""

import os
import subprocess
import sys
import threading
from pathlib import Path

_OPENERS = {"darwin": "open", "linux": "xdg-open"}


def open_page(page: Path | str) -> bool:
    """Open a local page or an address and return at once; False where there is no desktop, or nothing that opens pages.

    Text browsers, which would take over the terminal, are not used.
    """
    if sys.platform == "win32":
        os.startfile(page)
        return True
    has_display = sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    opener = _OPENERS.get(sys.platform)
    if not has_display or opener is None:
        return False
    quiet = subprocess.DEVNULL
    try:
        opened = subprocess.Popen([opener, str(page)], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    except OSError:
        return False
    # some openers last as long as the browser's window
    threading.Thread(target=opened.wait, daemon=True).start()
    return True
