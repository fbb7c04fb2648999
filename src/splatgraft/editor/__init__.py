"""The web editor: select and place objects and adjust their light in the browser.

Only `page/` imports viser. A `Project` (session/project_access.py) connects the editor to the steps; long work runs in
child processes.
"""
