"""The web editor: place the object in the browser and see the light. `page/` alone knows viser; the rest is logic.

Knows no steps: what it needs of them is handed in as a `Project` (project_access.py), long work is a child process.
"""
