"""The web editor: select and place objects and adjust their light in the browser.

Only `page/` imports viser. Everything else is a project's state and its files, previews, and jobs in child processes.
"""
