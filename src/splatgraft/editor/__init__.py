"""The web editor: select and place objects and adjust their light in the browser.

A server sends pictures of our renderer. Jobs and the light transfer run in child processes.
"""
