"""The editor's page: the only part that imports viser. Knows nothing about how anything is computed or saved."""
