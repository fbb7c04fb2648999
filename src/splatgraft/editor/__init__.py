"""The web editor: select and place objects and adjust their light in the browser.

A project's state and its files, a server, pictures of our renderer, and jobs and light in child processes.
"""
